//! The viewer for a long time: it listens to this machine only, answers nobody without its token, holds on when clients
//! stall or go away, and does not grow.
//!
//! A thousand requests without a pause are the short round. `RISORIUS_SOAK_SECS=3600` goes on for that long instead, with
//! `RISORIUS_SOAK_PER_SEC` requests a second (2 if that is not set), on the avatar in `RISORIUS_SOAK_RUN` if one is named.

use std::collections::VecDeque;
use std::fs;
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::str::FromStr;
use std::time::{Duration, Instant};

use crate::world::{Dice, Made, command, copy_of, world};

/// Requests of the short round.
const REQUESTS: u32 = 1000;
/// Requests before memory is looked at for the first time: buffers are as large as they get, and what opening the avatar
/// took has been given back.
const WARM: u32 = 500;
/// What memory may grow by. An allocator's arenas breathe; a picture of each request kept would be 6 MiB and more.
const GROWTH_KIB: u64 = 4 << 10;
/// Requests a second of a long round, about what somebody who plays with the sliders asks for.
const PER_SEC: f64 = 2.0;
/// Parts of a long round, at whose ends memory is told.
const PARTS: u32 = 6;

/// A setting of the long round.
fn setting<T: FromStr>(name: &str) -> Option<T> {
    let text = std::env::var(name).ok()?;
    Some(text.parse().unwrap_or_else(|_| panic!("{name} = `{text}` is not understood")))
}

/// `trainer view` at work; ends with the value.
struct Viewer {
    child: Child,
    _dir: Option<tempfile::TempDir>,
    port: u16,
    token: String,
}

impl Viewer {
    /// Shows an avatar of the world.
    fn start() -> Self {
        world(Made::Run);
        let dir = copy_of(Made::Run, &["run", "dataset"]);
        let view = command(dir.path(), "trainer view run");
        Self::watch(view, Some(dir))
    }

    fn watch(mut view: Command, dir: Option<tempfile::TempDir>) -> Self {
        let mut child = view.stderr(Stdio::piped()).spawn().unwrap();
        let mut line = String::new();
        let mut words = BufReader::new(child.stderr.take().unwrap());
        words.read_line(&mut line).unwrap();
        // What it says later is read too, or it would wait for the pipe.
        std::thread::spawn(move || std::io::copy(&mut words, &mut std::io::sink()));
        let url = line.split_whitespace().find(|w| w.starts_with("http")).unwrap_or_else(|| panic!("{line}"));
        let (place, token) = url.trim_end_matches('/').rsplit_once('/').unwrap();
        let port = place.rsplit(':').next().unwrap().parse().unwrap();
        let token = token.to_owned();
        Self { child, _dir: dir, port, token }
    }

    fn connect(&self) -> TcpStream {
        TcpStream::connect(("127.0.0.1", self.port)).unwrap()
    }

    /// Status and length of the answer.
    fn ask(&self, method: &str, path: &str, body: &[u8]) -> (u16, usize) {
        let mut stream = self.connect();
        let head = format!(
            "{method} {path} HTTP/1.1\r\nHost: 127.0.0.1:{}\r\nConnection: close\r\nContent-Length: {}\r\n\r\n",
            self.port,
            body.len()
        );
        stream.write_all(head.as_bytes()).unwrap();
        stream.write_all(body).unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        let status = String::from_utf8_lossy(&answer).split(' ').nth(1).and_then(|s| s.parse().ok()).unwrap();
        (status, answer.len())
    }

    /// Resident memory, KiB, where the system tells.
    fn memory_kib(&self) -> Option<u64> {
        let status = fs::read_to_string(format!("/proc/{}/status", self.child.id())).ok()?;
        let line = status.lines().find(|l| l.starts_with("VmRSS:"))?;
        line.split_whitespace().nth(1)?.parse().ok()
    }
}

impl Drop for Viewer {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Asks one of the things that clients ask, right and wrong.
fn ask_something(viewer: &Viewer, asked: u32, dice: &mut Dice) {
    let home = format!("/{}", viewer.token);
    let frame = format!("{home}/frame");
    let mut number = |most: f64| dice.roll() * most;
    let (status, _) = match asked % 8 {
        0 => viewer.ask("GET", &format!("{home}/info.json"), b""),
        1 => viewer.ask("GET", &format!("{home}/../../../etc/passwd"), b""),
        2 => viewer.ask("GET", "/", b""),
        3 => viewer.ask("POST", &frame, b"{\"aus\":"),
        4 => viewer.ask("POST", &format!("{home}/curves"), b"secs,AU12\n0,0\n1,x\n"),
        5 => {
            let text = format!("{{\"scale\":0.5,\"overlay\":\"depth\",\"jpeg\":true,\"slot\":{}}}", asked % 3);
            viewer.ask("POST", &frame, text.as_bytes())
        }
        _ => {
            let (yaw, au) = (number(60.0) - 30.0, number(5.0));
            let text = format!("{{\"scale\":0.5,\"orbit\":{{\"yaw_deg\":{yaw}}},\"aus\":{{\"AU12\":{au}}}}}");
            viewer.ask("POST", &frame, text.as_bytes())
        }
    };
    let expected: u16 = [200, 404, 404, 400, 400, 200, 200, 200][(asked % 8) as usize];
    assert_eq!(status, expected, "request {asked}");
}

#[test]
fn a_thousand_requests_leave_it_as_it_was() {
    let lasts = setting("RISORIUS_SOAK_SECS").map(Duration::from_secs);
    let viewer = match std::env::var("RISORIUS_SOAK_RUN") {
        Ok(run) => {
            let mut view = command(Path::new("."), "trainer view");
            view.arg(run);
            Viewer::watch(view, None)
        }
        Err(_) => Viewer::start(),
    };
    let pause = lasts.map(|_| Duration::from_secs_f64(1.0 / setting("RISORIUS_SOAK_PER_SEC").unwrap_or(PER_SEC)));
    if viewer.memory_kib().is_none() {
        eprintln!("SKIPPED: the system does not tell how much memory a process holds");
    }
    let memory = || viewer.memory_kib().unwrap_or(0);
    let mut dice = Dice(5);
    let (begun, mut asked, mut told) = (Instant::now(), 0u32, 0);
    let (mut warm, mut most, mut lately) = (None, memory(), VecDeque::new());
    eprintln!("| viewer, minutes | requests | KiB |\n|---|---|---|\n| 0 | 0 | {most} |");
    while asked < REQUESTS || lasts.is_some_and(|l| begun.elapsed() < l) {
        ask_something(&viewer, asked, &mut dice);
        asked += 1;
        let now = memory();
        // What a picture takes for its time comes and goes: what stays is the least of some requests.
        lately.push_back(now);
        if lately.len() > WARM as usize / 5 {
            lately.pop_front();
        }
        if asked == WARM {
            warm = lately.iter().copied().min();
        }
        most = most.max(now);
        if let Some(part) = lasts.map(|l| l / PARTS).filter(|part| begun.elapsed() >= *part * (told + 1)) {
            told += 1;
            eprintln!("| {:.1} | {asked} | {now} |", f64::from(told) * part.as_secs_f64() / 60.0);
        }
        // A request that took long is not made up for.
        std::thread::sleep(pause.unwrap_or_default());
    }
    let (warm, now) = (warm.unwrap_or(0), lately.iter().copied().min().unwrap_or(0));
    eprintln!(
        "{asked} requests in {:.0} s: {warm} KiB after {WARM} of them, {now} KiB at the end, at most {most} KiB",
        begun.elapsed().as_secs_f64()
    );
    // A large avatar's arenas breathe more; in a long round, what is kept of each request adds up to more than this.
    let room = if lasts.is_some() { GROWTH_KIB.max(warm / 10) } else { GROWTH_KIB };
    assert!(now < warm + room, "{warm} KiB after {WARM} requests, {now} KiB after {asked}");
}

#[test]
fn clients_that_stall_or_go_away_hold_nobody_up() {
    let viewer = Viewer::start();
    let info = format!("/{}/info.json", viewer.token);
    let host = format!("Host: 127.0.0.1:{}\r\n", viewer.port);
    let mut stalled = Vec::new();
    for text in [
        // Half a line, half a head, and a body that never comes from one without the token.
        "GE".to_owned(),
        format!("GET {info} HTTP/1.1\r\n{host}"),
        format!("POST /frame HTTP/1.1\r\n{host}Content-Length: 1000000\r\n\r\n{{"),
        format!("GET / HTTP/1.1\r\n{host}Transfer-Encoding: chunked\r\n\r\nffffff\r\n"),
    ] {
        let mut stream = viewer.connect();
        stream.write_all(text.as_bytes()).unwrap();
        stalled.push(stream);
        assert_eq!(viewer.ask("GET", &info, b"").0, 200, "after {text:?}");
    }
    // Gone in the middle of a request and of an answer.
    for _ in 0..20 {
        let mut stream = viewer.connect();
        let text = format!("POST /{}/frame HTTP/1.1\r\n{host}Content-Length: 900\r\n\r\n{{", viewer.token);
        stream.write_all(text.as_bytes()).unwrap();
        drop(stream);
        let mut stream = viewer.connect();
        let text = format!("POST /{}/frame HTTP/1.1\r\n{host}Content-Length: 11\r\n\r\n{{\"scale\":1}}", viewer.token);
        stream.write_all(text.as_bytes()).unwrap();
        drop(stream);
    }
    assert_eq!(viewer.ask("GET", &info, b"").0, 200);
    // More than is read of any body.
    let mut stream = viewer.connect();
    let head = format!("POST /{}/frame HTTP/1.1\r\n{host}Content-Length: 99999999999\r\n\r\n", viewer.token);
    stream.write_all(head.as_bytes()).unwrap();
    let block = vec![b' '; 1 << 20];
    for _ in 0..65 {
        if stream.write_all(&block).is_err() {
            break;
        }
    }
    drop(stream);
    assert_eq!(viewer.ask("GET", &info, b"").0, 200);
}

#[test]
#[cfg(target_os = "linux")]
fn it_listens_to_this_machine_only() {
    let viewer = Viewer::start();
    let sockets =
        fs::read_to_string("/proc/net/tcp").unwrap() + &fs::read_to_string("/proc/net/tcp6").unwrap_or_default();
    let port = format!(":{:04X}", viewer.port);
    // Local address and state; 0A listens.
    let listening: Vec<&str> = sockets
        .lines()
        .filter_map(|line| {
            let words: Vec<&str> = line.split_whitespace().collect();
            (words.get(3) == Some(&"0A") && words[1].ends_with(&port)).then(|| words[1])
        })
        .collect();
    assert_eq!(listening, [format!("0100007F{port}")], "127.0.0.1 and nothing else");
}
