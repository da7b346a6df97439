//! The cameras that the system knows, and what they can do.

use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::source::{self, Control, Mode};

/// Where Linux lists its video devices.
pub const SYSFS: &str = "/sys/class/video4linux";

/// A video device.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Device {
    /// The device file, such as `/dev/video0`.
    pub id: PathBuf,
    /// What its driver calls it.
    pub name: String,
}

/// The video devices listed in `sysfs` (normally [`SYSFS`]), by number; none where there is no such folder.
///
/// Cameras have further nodes for metadata, which give no pictures; their `index` is not 0, and they are left out.
pub fn devices(sysfs: &Path) -> Vec<Device> {
    let entries = std::fs::read_dir(sysfs).into_iter().flatten().flatten();
    let mut found: Vec<(u32, Device)> = entries
        .filter_map(|entry| {
            let node = entry.file_name().into_string().ok()?;
            let number = node.strip_prefix("video")?.parse().ok()?;
            let read = |file: &str| std::fs::read_to_string(entry.path().join(file)).ok();
            if read("index").is_some_and(|i| i.trim() != "0") {
                return None;
            }
            let name = read("name").unwrap_or_default().trim().to_owned();
            Some((number, Device { id: Path::new("/dev").join(node), name }))
        })
        .collect();
    found.sort_by_key(|(number, _)| *number);
    found.into_iter().map(|(_, device)| device).collect()
}

/// A camera with what it can do.
#[derive(Clone, Debug, Serialize)]
pub struct Camera {
    /// What `--device` takes.
    pub id: String,
    /// What its driver calls it.
    pub name: String,
    /// Its modes that can be recorded.
    pub modes: Vec<Mode>,
    /// Its controls.
    pub controls: Vec<Control>,
    /// Why it could not be asked, if so.
    pub error: Option<String>,
}

/// The cameras of the kernel's list in `sysfs` and of the other backends, each asked for its modes and controls.
///
/// One that cannot be opened, as another program uses it or the user may not, is listed with the reason.
pub fn cameras(sysfs: &Path) -> Vec<Camera> {
    let known = devices(sysfs).into_iter().map(|d| (d.id.display().to_string(), d.name));
    known.chain(source::other_cameras()).map(|(id, name)| ask(id, name)).collect()
}

/// Asks one camera.
pub fn ask(id: String, name: String) -> Camera {
    let asked = source::open(&id).and_then(|mut camera| {
        let modes = camera.modes(None)?;
        Ok((camera.name(), modes, camera.controls()?))
    });
    match asked {
        Ok((own, modes, controls)) => {
            Camera { id, name: if name.is_empty() { own } else { name }, modes, controls, error: None }
        }
        Err(e) => Camera { id, name, modes: Vec::new(), controls: Vec::new(), error: Some(e.to_string()) },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cameras_are_listed_by_number_without_their_metadata_nodes() {
        let dir = tempfile::tempdir().unwrap();
        for (node, name, index) in
            [("video10", "B\n", "0\n"), ("video2", "A\n", "0\n"), ("video3", "A\n", "1\n"), ("v4l-subdev0", "x", "0")]
        {
            std::fs::create_dir(dir.path().join(node)).unwrap();
            std::fs::write(dir.path().join(node).join("name"), name).unwrap();
            std::fs::write(dir.path().join(node).join("index"), index).unwrap();
        }
        let ids: Vec<_> = devices(dir.path()).into_iter().map(|d| (d.id, d.name)).collect();
        assert_eq!(ids, [("/dev/video2".into(), "A".to_owned()), ("/dev/video10".into(), "B".to_owned())]);
        assert!(devices(&dir.path().join("none")).is_empty());
    }
}
