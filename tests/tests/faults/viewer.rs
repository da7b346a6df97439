//! The viewer for a long time: it listens to this machine only, answers nobody without its token, holds on when clients
//! stall or go away, and does not grow.
//!
//! A thousand requests without a pause are the short round. `RISORIUS_SOAK_SECS=3600` goes on for that long instead, with
//! `RISORIUS_SOAK_PER_SEC` requests a second (2 if that is not set), on the avatar in `RISORIUS_SOAK_RUN` if one is named.

use std::fs;
use std::io::Write as _;
use std::path::Path;
use std::str::FromStr;
use std::time::{Duration, Instant};

use risorius_tests::Viewer;

use crate::world::{Made, command, copy_of, world};

/// Requests of the short round.
const REQUESTS: u32 = 1000;
/// Requests before memory is looked at for the first time: buffers are as large as they get.
const WARM: u32 = 500;
/// What resident memory may grow by. The allocator keeps what a picture took for a while, and gives it back when it sees
/// fit: by 20 to 50 MiB. What the viewer itself holds, `viewer_memory.rs` counts.
const GROWTH_KIB: u64 = 64 << 10;
/// Requests a second of a long round, about what somebody who plays with the sliders asks for.
const PER_SEC: f64 = 2.0;
/// Parts of a long round, at whose ends memory is told.
const PARTS: u32 = 6;

/// A setting of the long round.
fn setting<T: FromStr>(name: &str) -> Option<T> {
    let text = std::env::var(name).ok()?;
    Some(text.parse().unwrap_or_else(|_| panic!("{name} = `{text}` is not understood")))
}

/// Shows an avatar of the world, or that of the long round; the folder holds it.
fn shown() -> (Option<tempfile::TempDir>, Viewer) {
    if let Ok(run) = std::env::var("RISORIUS_SOAK_RUN") {
        return (None, Viewer::start(command(Path::new("."), "trainer view").arg(run)));
    }
    world(Made::Run);
    let dir = copy_of(Made::Run, &["run", "dataset"]);
    let viewer = Viewer::start(&mut command(dir.path(), "trainer view run"));
    (Some(dir), viewer)
}

#[test]
fn a_thousand_requests_leave_it_as_it_was() {
    let lasts = setting("RISORIUS_SOAK_SECS").map(Duration::from_secs);
    let (_dir, mut viewer) = shown();
    let pause = lasts.map(|_| Duration::from_secs_f64(1.0 / setting("RISORIUS_SOAK_PER_SEC").unwrap_or(PER_SEC)));
    if viewer.memory_kib().is_none() {
        eprintln!("SKIPPED: the system does not tell how much memory a process holds");
    }
    let mut now = viewer.memory_kib().unwrap_or(0);
    let (begun, mut asked, mut told) = (Instant::now(), 0u32, 0);
    let (mut warm, mut most) = (now, now);
    eprintln!("| viewer, minutes | requests | KiB |\n|---|---|---|\n| 0 | 0 | {now} |");
    while asked < REQUESTS || lasts.is_some_and(|l| begun.elapsed() < l) {
        viewer.visitor.ask_something();
        asked += 1;
        now = viewer.memory_kib().unwrap_or(0);
        if asked == WARM {
            warm = now;
        }
        most = most.max(now);
        if let Some(part) = lasts.map(|l| l / PARTS).filter(|part| begun.elapsed() >= *part * (told + 1)) {
            told += 1;
            eprintln!("| {:.1} | {asked} | {now} |", f64::from(told) * part.as_secs_f64() / 60.0);
        }
        // A request that took long is not made up for.
        std::thread::sleep(pause.unwrap_or_default());
    }
    eprintln!(
        "{asked} requests in {:.0} s: {warm} KiB after {WARM} of them, {now} KiB at the end, at most {most} KiB",
        begun.elapsed().as_secs_f64()
    );
    assert!(now < warm + GROWTH_KIB, "{warm} KiB after {WARM} requests, {now} KiB after {asked}");
}

#[test]
fn clients_that_stall_or_go_away_hold_nobody_up() {
    let (_dir, viewer) = shown();
    let visitor = &viewer.visitor;
    let info = format!("/{}/info.json", visitor.token);
    let host = format!("Host: 127.0.0.1:{}\r\n", visitor.port);
    let mut stalled = Vec::new();
    for text in [
        // Half a line, half a head, and a body that never comes from one without the token.
        "GE".to_owned(),
        format!("GET {info} HTTP/1.1\r\n{host}"),
        format!("POST /frame HTTP/1.1\r\n{host}Content-Length: 1000000\r\n\r\n{{"),
        format!("GET / HTTP/1.1\r\n{host}Transfer-Encoding: chunked\r\n\r\nffffff\r\n"),
    ] {
        let mut stream = visitor.connect();
        stream.write_all(text.as_bytes()).unwrap();
        stalled.push(stream);
        assert_eq!(visitor.ask("GET", &info, b""), 200, "after {text:?}");
    }
    // Gone in the middle of a request and of an answer.
    for _ in 0..20 {
        let mut stream = visitor.connect();
        let text = format!("POST /{}/frame HTTP/1.1\r\n{host}Content-Length: 900\r\n\r\n{{", visitor.token);
        stream.write_all(text.as_bytes()).unwrap();
        drop(stream);
        let mut stream = visitor.connect();
        let text = format!("POST /{}/frame HTTP/1.1\r\n{host}Content-Length: 11\r\n\r\n{{\"scale\":1}}", visitor.token);
        stream.write_all(text.as_bytes()).unwrap();
        drop(stream);
    }
    assert_eq!(visitor.ask("GET", &info, b""), 200);
    // More than is read of any body.
    let mut stream = visitor.connect();
    let head = format!("POST /{}/frame HTTP/1.1\r\n{host}Content-Length: 99999999999\r\n\r\n", visitor.token);
    stream.write_all(head.as_bytes()).unwrap();
    let block = vec![b' '; 1 << 20];
    for _ in 0..65 {
        if stream.write_all(&block).is_err() {
            break;
        }
    }
    drop(stream);
    assert_eq!(visitor.ask("GET", &info, b""), 200);
}

#[test]
#[cfg(target_os = "linux")]
fn it_listens_to_this_machine_only() {
    let (_dir, viewer) = shown();
    let sockets =
        fs::read_to_string("/proc/net/tcp").unwrap() + &fs::read_to_string("/proc/net/tcp6").unwrap_or_default();
    let port = format!(":{:04X}", viewer.visitor.port);
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
