//! Results that somebody made with the programs themselves are kept: `risorius avatar` goes on from them.

use std::path::Path;

use risorius_formats::hash::sha256_of_file;

/// The hash of a result's record, by which it is known again.
pub(super) fn record_hash(result: &Path) -> Option<String> {
    sha256_of_file(result.join("stage.json")).ok()
}

/// Whether the user made `result` with the programs themselves, from the take's `inputs` as they are now.
///
/// It is if the hash of its record differs from the one on the card (`noted`), or if the result (its file `main`) exists
/// without a record.
pub(super) fn is_by_hand(result: &Path, main: &str, take: &Path, inputs: &[&str], noted: Option<&str>) -> bool {
    let Some(hash) = record_hash(result) else { return result.join(main).is_file() };
    if noted == Some(hash.as_str()) {
        return false;
    }
    let record = std::fs::read(result.join("stage.json")).ok();
    let Some(record) = record.and_then(|bytes| serde_json::from_slice::<serde_json::Value>(&bytes).ok()) else {
        return false;
    };
    let same = |name: &&str| {
        let now = sha256_of_file(take.join(name)).ok();
        now.is_some() && record["inputs"][name].as_str() == now.as_deref()
    };
    record["finished"].as_bool() == Some(true) && inputs.iter().all(same)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_result_of_other_hands_is_known_by_its_record() {
        let dir = tempfile::tempdir().unwrap();
        let result = dir.path().join("track");
        std::fs::create_dir_all(&result).unwrap();
        let by_hand = |noted: Option<&str>| is_by_hand(&result, "a.csv", dir.path(), &["take.toml"], noted);
        assert!(!by_hand(None), "no result exists");
        std::fs::write(result.join("a.csv"), "x").unwrap();
        assert!(by_hand(None), "it has no record");
        std::fs::write(dir.path().join("take.toml"), "one").unwrap();
        let hash = sha256_of_file(dir.path().join("take.toml")).unwrap();
        let record = serde_json::json!({ "finished": true, "inputs": { "take.toml": hash } });
        std::fs::write(result.join("stage.json"), record.to_string()).unwrap();
        assert!(by_hand(None));
        assert!(!by_hand(record_hash(&result).as_deref()), "our own");
        std::fs::write(dir.path().join("take.toml"), "two").unwrap();
        assert!(!by_hand(None), "of another take");
    }
}
