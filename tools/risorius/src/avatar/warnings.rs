//! What the stages warned of, in plain words, each kind at most a few times.

use std::collections::BTreeMap;

use risorius_formats::Warning;

use crate::words::ours;

/// How many warnings of a kind are shown.
const SHOWN: usize = 2;
/// Kinds that are left out: another line of the card says the same, or they concern a command that was typed by itself.
const TOLD_ELSEWHERE: [&str; 5] = ["no-face", "stale-lock", "no-lpips", "budget", "few-candidates"];

/// The warnings as sentences.
pub(super) fn in_words(warnings: Vec<Warning>) -> Vec<String> {
    let mut kinds: BTreeMap<&'static str, Vec<String>> = BTreeMap::new();
    let mut order = Vec::new();
    for w in warnings.into_iter().filter(|w| !TOLD_ELSEWHERE.contains(&w.kind)) {
        let all = kinds.entry(w.kind).or_default();
        if all.is_empty() {
            order.push(w.kind);
        }
        if !all.contains(&w.message) {
            all.push(w.message);
        }
    }
    let mut words = Vec::new();
    for kind in order {
        let all = kinds.remove(kind).unwrap_or_default();
        let more = all.len().saturating_sub(SHOWN);
        words.extend(all.iter().take(SHOWN).map(|m| sentence(&ours(m))));
        if more > 0 {
            words.push(format!("… and {more} more like this."));
        }
    }
    words
}

/// Begins with a capital, unless with a name of a file, and ends with a full stop.
fn sentence(text: &str) -> String {
    let mut chars = text.chars();
    let first_word = text.split_whitespace().next().unwrap_or_default();
    let is_name = first_word.contains(['/', '.', '_', ':', '`']);
    let start = match chars.next() {
        Some(c) if !is_name => c.to_uppercase().chain(chars).collect::<String>(),
        _ => text.to_owned(),
    };
    if start.ends_with(['.', '!', '?']) { start } else { start + "." }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kinds_are_summed_up_and_some_left_out() {
        let all = ["one", "two", "two", "three", "four"].map(|m| Warning::new("gap", m));
        let mut all = all.to_vec();
        all.push(Warning::new("stale-lock", "took over"));
        all.push(Warning::new("other", "/a/b.mp4: is cut, see `tracker check TAKE`"));
        let words = in_words(all);
        let cut = "/a/b.mp4: is cut, see `risorius tracker check TAKE`.";
        assert_eq!(words, ["One.", "Two.", "… and 2 more like this.", cut]);
    }
}
