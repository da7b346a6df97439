//! Disks that are full, or that may only be read: a clear word, nothing half-written, and on with it once there is room.

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

use crate::kill::{Victim, check_same, of_avatars, of_datasets};
use crate::world::{Made, check_told, command, copy, files, hidden, rounds, run, said, succeed, world};

const ROOM_KIB: u64 = 2 << 20;

/// A small file system in memory, which is gone when dropped.
struct Disk {
    dir: tempfile::TempDir,
}

impl Disk {
    /// `None`, with a loud word, where this user may not mount.
    fn new() -> Option<Self> {
        let dir = tempfile::tempdir().unwrap();
        let disk = Self { dir };
        if disk.mount(&format!("size={ROOM_KIB}k")) {
            return Some(disk);
        }
        eprintln!("SKIPPED: `mount -t tmpfs` is not allowed here (root is needed)");
        None
    }

    fn mount(&self, options: &str) -> bool {
        let mut command = Command::new("mount");
        command.args(["-t", "tmpfs", "-o", options, "tmpfs"]).arg(self.dir.path());
        command.stderr(Stdio::null()).status().is_ok_and(|s| s.success())
    }

    fn path(&self) -> &Path {
        self.dir.path()
    }

    fn set(&self, options: &str) {
        assert!(self.mount(&format!("remount,{options}")), "remount,{options}");
    }

    fn used_kib(&self) -> u64 {
        let output = Command::new("df").args(["-k", "--output=used"]).arg(self.path()).output().unwrap();
        String::from_utf8_lossy(&output.stdout).lines().nth(1).unwrap().trim().parse().unwrap()
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(self.dir.path()).status();
    }
}

fn fill(disk: &Disk, world: &Path, victim: &Victim) {
    for entry in fs::read_dir(disk.path()).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() { fs::remove_dir_all(path).unwrap() } else { fs::remove_file(path).unwrap() }
    }
    for part in victim.given {
        copy(&world.join(part), &disk.path().join(part));
    }
}

#[test]
fn a_full_disk_is_told_and_what_was_there_stays() {
    let world = world(Made::Run);
    let Some(disk) = Disk::new() else { return };
    let mut tried = 0;
    // The short round takes every other command, and two at once the others.
    let step = if rounds() > 1 { 1 } else { 2 };
    for victim in of_datasets().iter().chain(&of_avatars()).step_by(step) {
        fill(&disk, &world, victim);
        let before = disk.used_kib();
        succeed(disk.path(), &victim.line);
        let expected = files(disk.path());
        let needed = disk.used_kib().saturating_sub(before).max(8);
        let shares: &[f64] = if rounds() > 1 { &[0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.95] } else { &[0.6] };
        for share in shares {
            disk.set(&format!("size={ROOM_KIB}k"));
            fill(&disk, &world, victim);
            let inputs = files(disk.path());
            disk.set(&format!("size={}k", disk.used_kib() + (needed as f64 * share) as u64));
            let output = run(disk.path(), &victim.line);
            // A folder that is replaced needs room for both, a file that is replaced may not.
            if !output.status.success() {
                let said = check_told(&victim.line, &output);
                assert!(said.contains("no space left"), "`{}`: {said}", victim.line);
                tried += 1;
            }
            let left = files(disk.path());
            assert!(hidden(&left).is_empty(), "`{}` left {:?}", victim.line, hidden(&left));
            for (name, bytes) in &inputs {
                assert!(left.get(name) == Some(bytes) || expected.get(name) == left.get(name), "{name} was lost");
            }
            disk.set(&format!("size={ROOM_KIB}k"));
            let line = victim.line_in(disk.path());
            let output = run(disk.path(), &line);
            assert!(output.status.success() || said(&output).contains("already exists"), "`{line}`: {}", said(&output));
            check_same(&line, &files(disk.path()), &expected);
        }
    }
    eprintln!("| full disk | {tried} | | |");
}

#[test]
fn a_folder_that_may_only_be_read_is_told() {
    let world = world(Made::Run);
    let Some(disk) = Disk::new() else { return };
    for victim in of_datasets().iter().chain(&of_avatars()) {
        disk.set("rw");
        fill(&disk, &world, victim);
        disk.set("ro");
        let before = files(disk.path());
        let output = run(disk.path(), &victim.line);
        let said = check_told(&victim.line, &output);
        assert!(said.contains("no permission"), "{said}");
        assert!(files(disk.path()) == before);
    }
}

/// Data that nobody takes: the reader of a pipe has gone, or the disk under a redirection is full.
#[test]
fn results_that_cannot_be_printed_are_no_bug() {
    let world = world(Made::Take);
    let Ok(full) = fs::File::options().write(true).open("/dev/full") else {
        eprintln!("SKIPPED: there is no /dev/full here");
        return;
    };
    let line = "capture -q check take --json";
    let output = command(&world, line).stdout(full).stderr(Stdio::piped()).output().unwrap();
    let said = said(&output);
    assert!(output.status.code() == Some(1) && said.contains("error: "), "{:?}: {said}", output.status);
}
