//! What the project says of itself and of what it is built from holds: licences, dependencies, the oldest compiler.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]
#![allow(clippy::print_stderr, reason = "a test that is skipped has to say so")]

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn read(path: &str) -> String {
    fs::read_to_string(root().join(path)).unwrap_or_else(|e| panic!("{path}: {e}"))
}

/// Crates that end in the programs, with their licences.
fn linked() -> BTreeMap<String, String> {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let output = Command::new(cargo)
        .args(["tree", "--offline", "--locked", "--workspace", "-e", "normal", "--prefix", "none"])
        .args(["--no-dedupe", "--format", "{p}|{l}"])
        .current_dir(root())
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let lines = text.lines().filter_map(|line| line.split_once('|'));
    let crates: BTreeMap<String, String> = lines
        .map(|(package, licence)| (package.split(' ').next().unwrap_or_default().to_owned(), licence.trim().to_owned()))
        .filter(|(name, _)| !name.starts_with("risorius"))
        .collect();
    assert!(crates.len() > 100, "{crates:?}");
    crates
}

/// Whether one may choose MIT or Apache-2.0 and needs to know of no other licence.
fn offers_ours(licence: &str) -> bool {
    if licence.contains(" AND ") {
        return false;
    }
    licence.replace('/', " OR ").split(" OR ").any(|l| matches!(l.trim(), "MIT" | "Apache-2.0"))
}

#[test]
fn licences_of_all_that_is_linked_or_fetched_are_told() {
    let page = read("docs/licences.md");
    let rows: Vec<&str> = page.lines().filter(|line| line.starts_with('|')).collect();
    let mut missing = Vec::new();
    for (name, licence) in linked().iter().filter(|(_, licence)| !offers_ours(licence)) {
        let licence = licence.replace('/', " OR ");
        let told = rows.iter().any(|row| row.contains(&format!("`{name}`")) && row.contains(&licence));
        if !told {
            missing.push(format!("{name}: {licence}"));
        }
    }
    assert!(missing.is_empty(), "docs/licences.md does not tell of: {missing:#?}");

    // What the set-up scripts fetch.
    let setup = read("tools/setup");
    let packages = setup.lines().find_map(|l| l.strip_prefix("packages=(")?.strip_suffix(')')).unwrap();
    let mut fetched: Vec<String> = packages.split(' ').map(str::to_owned).collect();
    for script in ["tools/models", "tools/test"] {
        // ("name", "version", "sha256 of 64 digits"
        fetched.extend(read(script).lines().filter_map(|line| {
            let parts: Vec<&str> = line.split('"').collect();
            let is_pinned = parts.iter().any(|p| p.len() == 64 && p.bytes().all(|b| b.is_ascii_hexdigit()));
            (is_pinned && parts.len() > 5).then(|| parts[1].to_owned())
        }));
    }
    fetched.extend(["cargo-deny", "playwright-core", "gltf-validator", "colmap", "onnxruntime"].map(str::to_owned));
    let untold: Vec<&String> =
        fetched.iter().filter(|name| !rows.iter().any(|row| row.contains(&format!("`{name}`")))).collect();
    assert!(untold.is_empty(), "docs/licences.md does not tell of what is fetched: {untold:?}");
    assert!(fetched.len() >= 8, "{fetched:?}");
}

#[test]
fn every_direct_dependency_has_its_reason() {
    let page = read("docs/dependencies.md");
    let manifest: toml::Table = toml::from_str(&read("Cargo.toml")).unwrap();
    let all = manifest["workspace"]["dependencies"].as_table().unwrap();
    let rows: Vec<&str> = page.lines().filter(|l| l.starts_with('|')).filter_map(|l| l.split('|').nth(1)).collect();
    let has_row = |name: &str| rows.iter().any(|cell| cell.split(',').any(|word| word.trim() == name));
    let missing: Vec<&String> = all.keys().filter(|n| !n.starts_with("risorius-") && !has_row(n)).collect();
    assert!(missing.is_empty(), "docs/dependencies.md has no reason for {missing:?}");
}

/// The oldest compiler is named once, and every crate takes that: clippy's `incompatible_msrv` then knows what is too new.
#[test]
fn the_oldest_compiler_is_the_same_everywhere() {
    let manifest: toml::Table = toml::from_str(&read("Cargo.toml")).unwrap();
    assert!(manifest["workspace"]["package"]["rust-version"].is_str());
    for member in manifest["workspace"]["members"].as_array().unwrap() {
        let member = member.as_str().unwrap();
        let own: toml::Table = toml::from_str(&read(&format!("{member}/Cargo.toml"))).unwrap();
        let version = &own["package"]["rust-version"];
        assert_eq!(version.get("workspace").and_then(toml::Value::as_bool), Some(true), "{member}");
        let lints = own.get("lints").and_then(|l| l.get("workspace")).and_then(toml::Value::as_bool);
        assert_eq!(lints, Some(true), "{member} takes the workspace's lints");
    }
}

#[test]
fn choices_of_licences_are_read() {
    for ours in ["MIT", "Apache-2.0 OR MIT", "Unlicense/MIT", "Zlib OR Apache-2.0 OR MIT"] {
        assert!(offers_ours(ours), "{ours}");
    }
    for other in ["BSD-3-Clause", "MIT AND Apache-2.0", "(MIT OR Apache-2.0) AND Unicode-3.0", "MPL-2.0"] {
        assert!(!offers_ours(other), "{other}");
    }
}
