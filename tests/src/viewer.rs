//! `trainer view` at work, and somebody who asks it right and wrong things.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::process::{Child, Command, Stdio};

use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

/// `trainer view` at work; ends with the value.
#[derive(Debug)]
pub struct Viewer {
    child: Child,
    /// Who knows its address.
    pub visitor: Visitor,
}

impl Viewer {
    /// Starts `view`, a command `trainer view …`, and waits until it says where it is.
    ///
    /// # Panics
    /// When it does not.
    #[must_use]
    pub fn start(view: &mut Command) -> Self {
        let mut child = view.stderr(Stdio::piped()).stdout(Stdio::null()).spawn().unwrap();
        let mut words = BufReader::new(child.stderr.take().unwrap());
        let mut line = String::new();
        words.read_line(&mut line).unwrap();
        // What it says later is read too, or it would wait for the pipe.
        std::thread::spawn(move || std::io::copy(&mut words, &mut std::io::sink()));
        let url = line.split_whitespace().find(|w| w.starts_with("http")).unwrap_or_else(|| panic!("{line}"));
        Self { child, visitor: Visitor::of(url) }
    }

    /// Gives it rows on its standard input, which the command must have piped.
    ///
    /// # Panics
    /// When it does not take them.
    pub fn tell(&mut self, rows: &str) {
        self.child.stdin.as_mut().unwrap().write_all(rows.as_bytes()).unwrap();
    }

    /// Ends its standard input.
    pub fn stop_telling(&mut self) {
        self.child.stdin = None;
    }

    /// Resident memory, KiB, where the system tells.
    #[must_use]
    pub fn memory_kib(&self) -> Option<u64> {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).ok()?;
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

/// An answer as it came.
#[derive(Debug)]
pub struct Answer {
    /// The status.
    pub status: u16,
    /// The lines before the body.
    pub head: String,
    /// The body.
    pub body: Vec<u8>,
}

/// Somebody who knows a viewer's address.
#[derive(Debug)]
pub struct Visitor {
    /// The address.
    pub url: String,
    /// Its port on this machine.
    pub port: u16,
    /// What the viewer lets in by.
    pub token: String,
    rng: ChaCha8Rng,
    asked: u64,
}

impl Visitor {
    /// Of the address that the viewer tells, `http://127.0.0.1:PORT/TOKEN/`.
    ///
    /// # Panics
    /// When `url` is no such address.
    #[must_use]
    pub fn of(url: &str) -> Self {
        let (place, token) = url.trim_end_matches('/').rsplit_once('/').unwrap();
        let port = place.rsplit(':').next().and_then(|port| port.parse().ok()).unwrap();
        Self { url: url.to_owned(), port, token: token.to_owned(), rng: ChaCha8Rng::seed_from_u64(5), asked: 0 }
    }

    /// A new connection.
    ///
    /// # Panics
    /// When nobody listens.
    #[must_use]
    pub fn connect(&self) -> TcpStream {
        TcpStream::connect(("127.0.0.1", self.port)).unwrap()
    }

    /// The answer to a request as it is written, once it has come whole. `headers` are further lines of its head, or one
    /// `Host:` instead of the right one.
    ///
    /// # Panics
    /// When none comes.
    #[must_use]
    pub fn request(&self, method: &str, path: &str, headers: &[&str], body: &[u8]) -> Answer {
        let mut stream = self.connect();
        let (asked, length) = (format!("{method} {path} HTTP/1.1"), format!("Content-Length: {}", body.len()));
        let host = format!("Host: 127.0.0.1:{}", self.port);
        let mut lines = vec![&*asked, "Connection: close", &*length];
        if !headers.iter().any(|h| h.starts_with("Host:")) {
            lines.push(&host);
        }
        lines.extend(headers);
        stream.write_all(format!("{}\r\n\r\n", lines.join("\r\n")).as_bytes()).unwrap();
        stream.write_all(body).unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        let split = answer.windows(4).position(|w| w == b"\r\n\r\n").unwrap();
        let head = String::from_utf8_lossy(&answer[..split]).into_owned();
        let status = head.split(' ').nth(1).and_then(|s| s.parse().ok()).unwrap();
        Answer { status, head, body: answer[split + 4..].to_vec() }
    }

    /// The status alone.
    ///
    /// # Panics
    /// When no answer comes.
    #[must_use]
    pub fn ask(&self, method: &str, path: &str, body: &[u8]) -> u16 {
        self.request(method, path, &[], body).status
    }

    /// Asks the next of the things that clients ask, right and wrong, in turn.
    ///
    /// # Panics
    /// When the answer has not the status that it should have.
    pub fn ask_something(&mut self) {
        let home = format!("/{}", self.token);
        let frame = format!("{home}/frame");
        let asked = self.asked;
        let (status, expected) = match asked % 8 {
            0 => (self.ask("GET", &format!("{home}/info.json"), b""), 200),
            1 => (self.ask("GET", &format!("{home}/../../../etc/passwd"), b""), 404),
            2 => (self.ask("GET", "/", b""), 404),
            3 => (self.ask("POST", &frame, b"{\"aus\":"), 400),
            4 => (self.ask("POST", &format!("{home}/curves"), b"secs,AU12\n0,0\n1,x\n"), 400),
            5 => {
                let text = format!("{{\"scale\":0.5,\"overlay\":\"depth\",\"jpeg\":true,\"slot\":{}}}", asked % 3);
                (self.ask("POST", &frame, text.as_bytes()), 200)
            }
            _ => {
                let (yaw, au) = (self.rng.random_range(-30.0..30.0), self.rng.random_range(0.0..5.0));
                let text = format!("{{\"scale\":0.5,\"orbit\":{{\"yaw_deg\":{yaw}}},\"aus\":{{\"AU12\":{au}}}}}");
                (self.ask("POST", &frame, text.as_bytes()), 200)
            }
        };
        assert_eq!(status, expected, "request {asked}");
        self.asked += 1;
    }
}
