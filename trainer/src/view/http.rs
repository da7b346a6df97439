//! Requests and answers.

use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::time::Instant;

use image::codecs::jpeg::JpegEncoder;
use risorius_formats::{AttributeSpec, Curves, Reporter, atomic};
use serde::Serialize;
use tiny_http::{Header, Method, Request, Response};

use super::live::Live;
use super::scene::{FrameRequest, Scene};
use super::shown_name;
use crate::avatar::Avatar;
use crate::error::Result;
use crate::jobs::transfer::Range;
use crate::path::CameraPath;
use crate::presets::PRESETS;

/// Bytes of a request that are read: a table of curves may be long, anything else is short.
const MAX_BODY: u64 = 64 << 20;

const PAGE: &str = include_str!("page/index.html");
const STYLE: &str = include_str!("page/style.css");
const SCRIPTS: [(&str, &str); 4] = [
    ("app.js", include_str!("page/app.js")),
    ("picture.js", include_str!("page/picture.js")),
    ("player.js", include_str!("page/player.js")),
    ("panel.js", include_str!("page/panel.js")),
];

/// An answer: status, type, bytes, further headers.
type Answer = (u16, &'static str, Vec<u8>, Vec<(&'static str, String)>);

/// What is served.
pub(super) struct Site<'a> {
    pub(super) token: String,
    pub(super) port: u16,
    avatar: &'a Avatar,
    run: PathBuf,
    scene: Scene<'a>,
    curves: Option<CurvesDocument>,
    live: Option<(Live, Range)>,
    pictures: u64,
}

/// What the page knows of the avatar.
#[derive(Serialize)]
struct Info<'a> {
    name: String,
    width: u32,
    height: u32,
    regions: &'a [String],
    aus: Vec<AuInfo>,
    presets: &'static [crate::presets::Preset],
    /// Half angles that the training cameras cover, degrees.
    seen_deg: [f64; 2],
    curves: Option<&'a CurvesDocument>,
    /// Whether rows come while the page is open.
    live: bool,
}

/// What a page knows of an AU.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct AuInfo {
    unit: String,
    name: &'static str,
    region: usize,
    neutral: f32,
    max: f32,
    active: bool,
}

impl From<&AttributeSpec> for AuInfo {
    fn from(spec: &AttributeSpec) -> Self {
        Self {
            unit: spec.unit.to_string(),
            name: spec.unit.facs_name(),
            region: spec.region,
            neutral: spec.neutral,
            max: spec.au_max,
            active: spec.active,
        }
    }
}

/// Curves for a page's player.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct CurvesDocument {
    name: String,
    units: Vec<String>,
    times_secs: Vec<f64>,
    rows: Vec<Vec<Option<f32>>>,
}

/// Reads a table of curves for the page.
pub(super) fn curves_of(path: &Path, reporter: &dyn Reporter) -> Result<CurvesDocument> {
    let curves = Curves::read(path, reporter)?;
    Ok(CurvesDocument::new(shown_name(path), &curves))
}

impl CurvesDocument {
    pub(crate) fn new(name: String, curves: &Curves) -> Self {
        Self {
            name,
            units: curves.units.iter().map(ToString::to_string).collect(),
            times_secs: curves.times_secs.clone(),
            rows: curves.rows.clone(),
        }
    }
}

impl<'a> Site<'a> {
    pub(super) fn new(
        avatar: &'a Avatar,
        run: &Path,
        token: String,
        port: u16,
        curves: Option<CurvesDocument>,
        live: Option<(Live, Range)>,
    ) -> Self {
        Self { token, port, avatar, run: run.to_owned(), scene: Scene::new(avatar), curves, live, pictures: 0 }
    }

    pub(super) fn pictures(&self) -> u64 {
        self.pictures
    }

    /// Who is let in.
    pub(super) fn door(&self) -> Door {
        Door { token: self.token.clone(), port: self.port }
    }

    /// Answers one request; a browser that has gone away is no error, and one that reads slowly is not waited for.
    pub(super) fn answer(&mut self, received: Received, reporter: &dyn Reporter) {
        let Received { request, path, body } = received;
        let answer = match body {
            Ok(body) => self.route(request.method(), &path, &body, reporter),
            Err(answer) => answer,
        };
        std::thread::spawn(move || respond(request, answer));
    }

    fn route(&mut self, method: &Method, path: &str, body: &[u8], reporter: &dyn Reporter) -> Answer {
        match (method, path) {
            (Method::Get, "/" | "/index.html") => (200, "text/html; charset=utf-8", PAGE.into(), Vec::new()),
            (Method::Get, "/style.css") => (200, "text/css; charset=utf-8", STYLE.into(), Vec::new()),
            (Method::Get, "/info.json") => json(&self.info()),
            (Method::Get, path) => match SCRIPTS.iter().find(|(name, _)| path.strip_prefix('/') == Some(*name)) {
                Some((_, script)) => (200, "text/javascript; charset=utf-8", (*script).into(), Vec::new()),
                None => text(404, "nothing here"),
            },
            (Method::Post, "/frame") => self.frame(body, reporter),
            (Method::Post, "/curves") => read_curves(body, reporter),
            (Method::Post, "/path") => self.save_path(body),
            _ => text(404, "nothing here"),
        }
    }

    fn info(&self) -> Info<'_> {
        let saved = &self.avatar.saved;
        let (width, height) = self.scene.size();
        Info {
            name: shown_name(&self.run),
            width,
            height,
            regions: &saved.table.regions,
            aus: saved.table.attributes.iter().map(AuInfo::from).collect(),
            presets: &PRESETS,
            // `orbit_rad` is three quarters of what is covered.
            seen_deg: saved.orbit_rad.map(|a| (a / 0.75).to_degrees()),
            curves: self.curves.as_ref(),
            live: self.live.is_some(),
        }
    }

    fn frame(&mut self, body: &[u8], reporter: &dyn Reporter) -> Answer {
        let mut wanted: FrameRequest = match serde_json::from_slice(body) {
            Ok(wanted) => wanted,
            Err(e) => return text(400, &format!("the request is not understood: {e}")),
        };
        let driven = self.live.as_ref().filter(|_| wanted.live).map(|(live, range)| {
            let now = live.now();
            self.scene.drive(&mut wanted, &now, *range);
            serde_json::json!({ "aus": &wanted.aus, "status": now.status })
        });
        let started = Instant::now();
        let picture = match self.scene.frame(&wanted, reporter) {
            Ok(picture) => picture,
            Err(e) => return text(500, &e.to_string()),
        };
        self.pictures += 1;
        let mut more = vec![
            ("X-Width", picture.width().to_string()),
            ("X-Height", picture.height().to_string()),
            ("X-Millis", format!("{:.1}", started.elapsed().as_secs_f64() * 1e3)),
        ];
        more.extend(driven.map(|driven| ("X-Live", ascii(&driven.to_string()))));
        if !wanted.jpeg {
            return (200, "application/octet-stream", picture.into_raw(), more);
        }
        let mut bytes = Vec::new();
        match JpegEncoder::new_with_quality(&mut bytes, 90).encode_image(&picture) {
            Ok(()) => (200, "image/jpeg", bytes, more),
            Err(e) => text(500, &e.to_string()),
        }
    }

    /// Keeps a camera path in the run's folder, under a name of the server's own making.
    fn save_path(&self, body: &[u8]) -> Answer {
        let path: CameraPath = match serde_json::from_slice(body) {
            Ok(path) => path,
            Err(e) => return text(400, &format!("the path is not understood: {e}")),
        };
        if let Err(e) = path.check() {
            return text(400, &e.to_string());
        }
        let folder = self.run.join("paths");
        let Some(file) = (1..10_000).map(|n| folder.join(format!("path_{n:03}.toml"))).find(|f| !f.exists()) else {
            return text(500, "there are too many paths in this run");
        };
        let written = path.to_toml().and_then(|text| atomic::write_file(&file, text.as_bytes()));
        match written {
            Ok(()) => json(&serde_json::json!({ "file": file.display().to_string() })),
            Err(e) => text(500, &e.to_string()),
        }
    }
}

/// Tells who may come in by token and headers.
#[derive(Clone, Debug)]
pub(super) struct Door {
    token: String,
    port: u16,
}

/// A request of one who may come in.
pub(super) struct Received {
    request: Request,
    /// What follows the token.
    path: String,
    body: std::result::Result<Vec<u8>, Answer>,
}

impl Door {
    /// Reads a request to its end, or turns it away.
    pub(super) fn receive(&self, mut request: Request) -> Option<Received> {
        match self.path(&request) {
            Ok(path) => {
                let body = body(&mut request);
                Some(Received { request, path, body })
            }
            Err(answer) => {
                respond(request, answer);
                None
            }
        }
    }

    fn path(&self, request: &Request) -> std::result::Result<String, Answer> {
        if !self.is_from_here(request) {
            return Err(text(403, "only pages of this server are answered"));
        }
        let path = request.url().split(['?', '#']).next().unwrap_or_default();
        // Without the token there is nothing, not even a hint.
        let path = path.strip_prefix('/').and_then(|p| p.strip_prefix(self.token.as_str()));
        path.map(str::to_owned).ok_or_else(|| text(404, "nothing here; open the address that `trainer view` printed"))
    }

    /// Whether the request names this server as its host and, if it says where it comes from, comes from its pages.
    fn is_from_here(&self, request: &Request) -> bool {
        let header = |name: &'static str| {
            request.headers().iter().find(|h| h.field.equiv(name)).map(|h| h.value.as_str().to_ascii_lowercase())
        };
        let mine = ["127.0.0.1", "localhost"].map(|host| format!("{host}:{}", self.port));
        let host = header("Host").unwrap_or_default();
        let origin = header("Origin");
        mine.contains(&host) && origin.is_none_or(|o| mine.iter().any(|m| o == format!("http://{m}")))
    }
}

fn respond(request: Request, (status, kind, body, more): Answer) {
    let mut response = Response::from_data(body).with_status_code(status);
    let fixed = [
        ("Content-Type", kind),
        ("Cache-Control", "no-store"),
        ("X-Content-Type-Options", "nosniff"),
        ("X-Frame-Options", "DENY"),
        ("Referrer-Policy", "no-referrer"),
        // Nothing is loaded from elsewhere; curves of the user's files are read as data.
        ("Content-Security-Policy", "default-src 'self'; img-src 'self' blob: data:; frame-ancestors 'none'"),
    ];
    let all = fixed.iter().map(|(k, v)| (*k, (*v).to_owned())).chain(more);
    for (name, value) in all {
        if let Ok(header) = Header::from_bytes(name.as_bytes(), value.as_bytes()) {
            response.add_header(header);
        }
    }
    let _ = request.respond(response);
}

fn read_curves(body: &[u8], reporter: &dyn Reporter) -> Answer {
    match Curves::parse(body, reporter) {
        Ok(curves) => json(&CurvesDocument::new("curves".to_owned(), &curves)),
        Err(e) => {
            let hint = risorius_formats::Hint::hint(&e).map_or_else(String::new, |h| format!("; {h}"));
            text(400, &format!("{e}{hint}"))
        }
    }
}

fn body(request: &mut Request) -> std::result::Result<Vec<u8>, Answer> {
    let mut body = Vec::new();
    match request.as_reader().take(MAX_BODY + 1).read_to_end(&mut body) {
        Ok(n) if n as u64 <= MAX_BODY => Ok(body),
        Ok(_) => Err(text(413, "more than 64 MiB")),
        Err(e) => Err(text(400, &format!("the request broke off: {e}"))),
    }
}

fn json(value: &impl Serialize) -> Answer {
    match serde_json::to_vec(value) {
        Ok(bytes) => (200, "application/json", bytes, Vec::new()),
        Err(e) => text(500, &e.to_string()),
    }
}

/// JSON for a header: what is not ASCII is escaped.
fn ascii(json: &str) -> String {
    let mut units = [0u16; 2];
    json.chars().fold(String::new(), |mut out, c| {
        if c.is_ascii() {
            out.push(c);
        } else {
            out.extend(c.encode_utf16(&mut units).iter().map(|u| format!("\\u{u:04x}")));
        }
        out
    })
}

fn text(status: u16, message: &str) -> Answer {
    (status, "text/plain; charset=utf-8", message.as_bytes().to_vec(), Vec::new())
}
