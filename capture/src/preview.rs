//! A page on this machine that shows what is being recorded: the newest picture, the figures, and the script's prompt.
//!
//! It listens on the loopback address alone and answers only requests that name it, so that no other page or machine sees
//! the camera.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use crate::live::Meter;
use crate::{CaptureError, Result};

const PAGE: &str = include_str!("preview.html");
/// A request's head may be so long.
const LONGEST_HEAD: u64 = 8192;
const PATIENCE: Duration = Duration::from_secs(2);

/// The page's server; it ends when this is dropped.
#[derive(Debug)]
pub struct Preview {
    address: SocketAddr,
    shared: Arc<Shared>,
    server: Option<JoinHandle<()>>,
}

#[derive(Debug, Default)]
struct Shared {
    picture: Mutex<Arc<Vec<u8>>>,
    meter: Mutex<Meter>,
    stop: AtomicBool,
}

impl Preview {
    /// Serves the page on a free port, or on `port`.
    pub fn serve(port: u16) -> Result<Self> {
        let fail = |e: std::io::Error| CaptureError::Preview { message: e.to_string() };
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, port)).map_err(fail)?;
        let address = listener.local_addr().map_err(fail)?;
        let shared = Arc::new(Shared::default());
        let theirs = Arc::clone(&shared);
        let server = std::thread::spawn(move || {
            for stream in listener.incoming() {
                if theirs.stop.load(Ordering::Relaxed) {
                    return;
                }
                // One request at a time: a page asks for one picture after the other.
                if let Ok(stream) = stream {
                    let _ = answer(&stream, address, &theirs);
                }
            }
        });
        Ok(Self { address, shared, server: Some(server) })
    }

    /// Where the page is.
    pub fn url(&self) -> String {
        format!("http://{}/", self.address)
    }

    /// Shows a JPEG picture.
    pub fn set_picture(&self, jpeg: Vec<u8>) {
        *self.shared.picture.lock().unwrap_or_else(PoisonError::into_inner) = Arc::new(jpeg);
    }

    /// Shows figures.
    pub fn set_meter(&self, meter: &Meter) {
        self.shared.meter.lock().unwrap_or_else(PoisonError::into_inner).clone_from(meter);
    }
}

impl Drop for Preview {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        // Wakes the server up.
        let _ = TcpStream::connect_timeout(&self.address, PATIENCE);
        if let Some(server) = self.server.take() {
            let _ = server.join();
        }
    }
}

fn answer(mut stream: &TcpStream, address: SocketAddr, shared: &Shared) -> std::io::Result<()> {
    stream.set_read_timeout(Some(PATIENCE))?;
    stream.set_write_timeout(Some(PATIENCE))?;
    let mut lines = BufReader::new(stream.take(LONGEST_HEAD)).lines();
    let request = lines.next().transpose()?.unwrap_or_default();
    let mut host = String::new();
    for line in lines {
        let line = line?;
        if line.is_empty() {
            break;
        }
        if let Some((name, value)) = line.split_once(':')
            && name.eq_ignore_ascii_case("host")
        {
            value.trim().clone_into(&mut host);
        }
    }
    // A page of another name that leads here would be somebody else's.
    let is_ours = host == address.to_string() || host == format!("localhost:{}", address.port());
    let path = request.strip_prefix("GET ").and_then(|r| r.split(' ').next()).map(|p| p.split('?').next().unwrap_or(p));
    let (status, kind, body) = match path {
        _ if !is_ours => ("403 Forbidden", "text/plain", b"not this page".to_vec()),
        Some("/") => ("200 OK", "text/html; charset=utf-8", PAGE.as_bytes().to_vec()),
        Some("/picture.jpg") => {
            let picture = Arc::clone(&shared.picture.lock().unwrap_or_else(PoisonError::into_inner));
            let status = if picture.is_empty() { "404 Not Found" } else { "200 OK" };
            (status, "image/jpeg", picture.to_vec())
        }
        Some("/meter.json") => {
            let meter = shared.meter.lock().unwrap_or_else(PoisonError::into_inner).clone();
            ("200 OK", "application/json", serde_json::to_vec(&meter).unwrap_or_default())
        }
        _ => ("404 Not Found", "text/plain", b"not here".to_vec()),
    };
    let head = format!(
        "HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {}\r\nCache-Control: no-store\r\nConnection: close\r\n\r\n",
        body.len()
    );
    stream.write_all(head.as_bytes())?;
    stream.write_all(&body)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn get(preview: &Preview, path: &str, host: Option<&str>) -> String {
        let mut stream = TcpStream::connect(preview.address).unwrap();
        let own = preview.address.to_string();
        write!(stream, "GET {path} HTTP/1.1\r\nHost: {}\r\n\r\n", host.unwrap_or(&own)).unwrap();
        let mut out = Vec::new();
        stream.read_to_end(&mut out).unwrap();
        String::from_utf8_lossy(&out).into_owned()
    }

    #[test]
    fn the_page_its_picture_and_its_figures_are_served_to_this_machine_alone() {
        let preview = Preview::serve(0).unwrap();
        assert!(preview.url().starts_with("http://127.0.0.1:"));
        assert!(get(&preview, "/", None).contains("<title>"));
        assert!(get(&preview, "/picture.jpg", None).starts_with("HTTP/1.1 404"));
        preview.set_picture(b"JPEG".to_vec());
        preview.set_meter(&Meter { fps: 119.5, prompt: Some("smile".to_owned()), ..Meter::default() });
        assert!(get(&preview, "/picture.jpg?7", None).ends_with("JPEG"));
        let meter = get(&preview, "/meter.json", None);
        assert!(meter.contains("\"fps\":119.5") && meter.contains("smile"), "{meter}");
        assert!(get(&preview, "/picture.jpg", Some("evil.example")).starts_with("HTTP/1.1 403"));
        assert!(get(&preview, "/take.toml", None).starts_with("HTTP/1.1 404"));
        drop(preview);
    }
}
