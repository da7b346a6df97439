//! What the coverage-guided fuzzer starts from (`fuzz/seeds`) and what it once found (`fuzz/found`), through its own
//! targets: without a nightly toolchain, and at every run of the tests.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use crate::MEMORY;
use crate::fuzz_files::{ROOM_BYTES, TIMES};

#[path = "../../../fuzz/src/lib.rs"]
#[allow(unreachable_pub, reason = "a library's root there")]
mod targets;

type Target = fn(u8, &[u8]);

#[test]
fn seeds_and_finds_of_the_fuzzer_hold() {
    let fuzz = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz");
    let all: [(&str, Target); 4] =
        [("tables", targets::tables), ("colmap", targets::colmap), ("json", targets::json), ("text", targets::text)];
    let (mut tried, mut wrong) = (0, Vec::new());
    for (name, target) in all {
        let mut own = 0;
        for folder in ["seeds", "found"] {
            for entry in std::fs::read_dir(fuzz.join(folder).join(name)).into_iter().flatten() {
                let path = entry.unwrap().path();
                let bytes = std::fs::read(&path).unwrap();
                let Some((choice, rest)) = bytes.split_first() else { continue };
                MEMORY.reset_peak_usage();
                let before = MEMORY.current_usage();
                let held = catch_unwind(AssertUnwindSafe(|| target(*choice, rest))).is_ok();
                let used = MEMORY.peak_usage().saturating_sub(before);
                if !held || used > ROOM_BYTES + TIMES * bytes.len() {
                    wrong.push(format!("{} took {used} bytes", path.display()));
                }
                own += 1;
            }
        }
        assert!(own >= 3, "{name} has {own} seeds");
        tried += own;
    }
    eprintln!("{tried} seeds and finds");
    assert!(wrong.is_empty(), "{wrong:?}");
}
