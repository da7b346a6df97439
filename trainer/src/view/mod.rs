//! `trainer view`: a page on this machine that shows the avatar while it is turned and steered.
//!
//! ```text
//! browser ── POST /TOKEN/frame {angles, AUs, size, overlay} ──▶ http ──▶ scene (one Studio per use) ──▶ raw RGB
//!                                             rows ──▶ live ──▶ AUs in their place, where the page follows a face
//! ```
//!
//! The browser asks for one picture at a time, so what is on the screen is never older than one picture, and a slow
//! machine gets fewer pictures, not a queue. The server listens on the loopback interface only; its address holds a
//! random token, without which every path answers 404, and requests that name another host (DNS rebinding) or come from
//! another page (`Origin`) are refused.

mod http;
mod live;
mod overlay;
mod scene;

use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;
use std::time::Duration;

use risorius_formats::Reporter;

use crate::avatar::Avatar;
use crate::error::{Result, TrainerError};
use crate::jobs::transfer::Range;
pub(crate) use http::{AuInfo, CurvesDocument};
pub use live::Live;
pub(crate) use overlay::ramp;
pub use scene::{FrameRequest, Overlay, Scene};

/// How long the server waits before it looks whether the user has stopped it.
const PATIENCE: Duration = Duration::from_millis(200);

/// How to serve.
#[derive(Clone, Debug)]
pub struct ViewSettings {
    /// The run's folder: its name is shown, and camera paths are saved in it.
    pub run: PathBuf,
    /// The port; 0 takes a free one.
    pub port: u16,
    /// A table of AU curves that the page offers to play.
    pub curves: Option<PathBuf>,
    /// Rows that come while the page is open: `-` for standard input, or a file such as a named pipe.
    pub live: Option<PathBuf>,
    /// Whose range turns the rows' intensities into attributes.
    pub live_range: Range,
}

/// A server that is bound and not yet serving.
pub struct Viewer<'a> {
    server: tiny_http::Server,
    site: http::Site<'a>,
}

impl<'a> Viewer<'a> {
    /// Binds the port on the loopback interface.
    pub fn bind(avatar: &'a Avatar, settings: &ViewSettings, reporter: &dyn Reporter) -> Result<Self> {
        let address = SocketAddr::from((Ipv4Addr::LOCALHOST, settings.port));
        let server = tiny_http::Server::http(address).map_err(|e| TrainerError::Setting {
            message: format!("cannot listen on {address}: {e}"),
            hint: "another program may use the port; `--port 0` takes a free one".to_owned(),
        })?;
        let port = server.server_addr().to_ip().map_or(settings.port, |a| a.port());
        let curves = settings.curves.as_deref().map(|path| http::curves_of(path, reporter)).transpose()?;
        let live = settings.live.as_deref().map(Live::follow).transpose()?;
        let live = live.map(|live| (live, settings.live_range));
        let site = http::Site::new(avatar, &settings.run, token()?, port, curves, live);
        Ok(Self { server, site })
    }

    /// The address to open, token included.
    pub fn url(&self) -> String {
        format!("http://127.0.0.1:{}/{}/", self.site.port, self.site.token)
    }

    /// Answers until the user stops it; gives the number of pictures that were rendered.
    pub fn serve(self, reporter: &dyn Reporter) -> Result<u64> {
        let Self { server, mut site } = self;
        let door = site.door();
        let (sender, whole) = mpsc::channel();
        let stopped = AtomicBool::new(false);
        std::thread::scope(|scope| {
            let listener = scope.spawn({
                let (server, door, stopped) = (&server, &door, &stopped);
                move || listen(server, door, &sender, stopped)
            });
            while !reporter.cancelled() {
                match whole.recv_timeout(PATIENCE) {
                    Ok(received) => site.answer(received, reporter),
                    Err(mpsc::RecvTimeoutError::Timeout) => {}
                    // The listener has ended, which it does not do by itself.
                    Err(mpsc::RecvTimeoutError::Disconnected) => break,
                }
            }
            stopped.store(true, Ordering::Relaxed);
            // A panic over there is a bug that goes on here.
            listener.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
        })?;
        Ok(site.pictures())
    }
}

/// Hands on requests once they are whole. Each is waited for on a thread of its own, so that a client that stalls holds
/// nobody up.
fn listen(
    server: &tiny_http::Server,
    door: &http::Door,
    whole: &mpsc::Sender<http::Received>,
    stopped: &AtomicBool,
) -> Result<()> {
    while !stopped.load(Ordering::Relaxed) {
        match server.recv_timeout(PATIENCE) {
            Ok(Some(request)) => {
                let (door, whole) = (door.clone(), whole.clone());
                std::thread::spawn(move || {
                    if let Some(received) = door.receive(request) {
                        // Nobody is there any more when the viewer was stopped.
                        let _ = whole.send(received);
                    }
                });
            }
            Ok(None) => {}
            Err(e) => {
                let message = format!("the server stopped: {e}");
                return Err(TrainerError::Setting { message, hint: "start `trainer view` again".to_owned() });
            }
        }
    }
    Ok(())
}

/// 128 random bits as text.
fn token() -> Result<String> {
    let mut bytes = [0u8; 16];
    getrandom::fill(&mut bytes).map_err(|e| TrainerError::Setting {
        message: format!("the system gives no random numbers: {e}"),
        hint: String::new(),
    })?;
    Ok(format!("{:032x}", u128::from_le_bytes(bytes)))
}

/// The name of a folder for people.
pub(crate) fn shown_name(path: &Path) -> String {
    let full = path.canonicalize().unwrap_or_else(|_| path.to_owned());
    full.file_name().map_or_else(|| "avatar".to_owned(), |n| n.to_string_lossy().into_owned())
}
