//! `annotations.yml` and `mapping.yml` (fact sheet §3.7).

use std::collections::BTreeMap;
use std::fmt::Write as _;

use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_saphyr::Spanned;

use super::Annotation;
use crate::{ErrorKind, FormatError, Result};

#[derive(Deserialize)]
struct Entry {
    class: usize,
    frame: u32,
    value: f32,
}

fn parse<T: DeserializeOwned>(bytes: &[u8]) -> Result<T> {
    let text = std::str::from_utf8(bytes).map_err(|e| FormatError::syntax(format!("is not UTF-8 text: {e}")))?;
    // An entry is seven nodes, and a frame has an entry per AU: the usual limits would stop at 2,100 frames.
    let options = serde_saphyr::options! {
        with_snippet: false,
        budget: serde_saphyr::budget! { max_nodes: 50_000_000, max_events: 100_000_000 },
    };
    serde_saphyr::from_str_with_options(text, options).map_err(|e| {
        let message = e.to_string();
        let message = message.lines().next().unwrap_or("not YAML").trim();
        let error = FormatError::syntax(message.to_owned());
        match e.location() {
            Some(place) if place.line() > 0 => error.at_line(place.line()),
            _ => error,
        }
    })
}

/// Parses `annotations.yml`. With `classes` above 0 (the length of the mapping), no entry may name a class beyond.
pub fn parse_annotations(bytes: &[u8], classes: usize) -> Result<Vec<Annotation>> {
    if bytes.iter().all(u8::is_ascii_whitespace) {
        return Ok(Vec::new());
    }
    let entries: Option<Vec<Spanned<Entry>>> = parse(bytes)?;
    let check = |entry: Spanned<Entry>| {
        let Entry { class, frame, value } = entry.value;
        let message = if !value.is_finite() {
            format!("frame {frame}: the value `{value}` is not a number")
        } else if classes > 0 && class >= classes {
            format!("frame {frame}: class {class}, but mapping.yml has {classes}")
        } else {
            return Ok(Annotation { class, frame, value });
        };
        let error = FormatError::new(ErrorKind::Inconsistent, message);
        Err(if entry.referenced.line() > 0 { error.at_line(entry.referenced.line()) } else { error })
    };
    entries.unwrap_or_default().into_iter().map(check).collect()
}

/// Parses `mapping.yml`: class index to name, without gaps.
pub fn parse_mapping(bytes: &[u8]) -> Result<Vec<String>> {
    if bytes.iter().all(u8::is_ascii_whitespace) {
        return Ok(Vec::new());
    }
    let entries: Option<BTreeMap<usize, String>> = parse(bytes)?;
    let entries = entries.unwrap_or_default();
    for (expected, (&index, _)) in entries.iter().enumerate() {
        if index != expected {
            return Err(FormatError::new(ErrorKind::Inconsistent, format!("class {expected} is missing")));
        }
    }
    Ok(entries.into_values().collect())
}

/// The text of `annotations.yml`.
pub(super) fn annotations_text(annotations: &[Annotation]) -> String {
    if annotations.is_empty() {
        return "[]\n".to_owned();
    }
    let mut text = String::with_capacity(annotations.len() * 48);
    for Annotation { class, frame, value } in annotations {
        // Always with a point and never with an exponent: YAML 1.1 readers take `1` for an integer and `1e-7` for a word.
        let point = if value.fract() == 0.0 { ".0" } else { "" };
        let _ = writeln!(text, "- class: {class}\n  frame: {frame}\n  value: {value}{point}");
    }
    text
}

/// The text of `mapping.yml`.
pub(super) fn mapping_text(names: &[String]) -> String {
    let mut text = String::new();
    for (index, name) in names.iter().enumerate() {
        // Plain only where no YAML version can take it for anything but a word.
        let plain = name.len() > 3
            && name.starts_with(|c: char| c.is_ascii_uppercase())
            && name.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_')
            && name.bytes().any(|b| b.is_ascii_digit());
        let shown = if plain { name.clone() } else { serde_json::Value::from(name.as_str()).to_string() };
        let _ = writeln!(text, "{index}: {shown}");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn block_and_flow_style_and_whole_numbers_are_read() {
        let block = "# by hand\n- class: 0\n  frame: 12\n  value: -1\n- {class: 1, frame: 12, value: 0.5}\n- value: 1.0e-3\n  frame: 3\n  class: 0\n";
        let got = parse_annotations(block.as_bytes(), 2).unwrap();
        assert_eq!(
            got.iter().map(|a| (a.class, a.frame, a.value)).collect::<Vec<_>>(),
            [(0, 12, -1.0), (1, 12, 0.5), (0, 3, 0.001)]
        );
        for nothing in ["", " \n", "[]", "null"] {
            assert!(parse_annotations(nothing.as_bytes(), 2).unwrap().is_empty(), "{nothing:?}");
        }
    }

    #[test]
    fn errors_name_their_line() {
        let far = "- class: 0\n  frame: 1\n  value: 0.1\n- class: 7\n  frame: 1\n  value: 0.1\n";
        assert_eq!(parse_annotations(far.as_bytes(), 2).unwrap_err().line(), Some(4));
        assert_eq!(parse_annotations(far.as_bytes(), 0).unwrap().len(), 2);
        for broken in [
            "- class: 0\n  frame: 1\n  value: .nan\n",
            "- class: -1\n  frame: 1\n  value: 0\n",
            "- class: 0\n  frame: one\n  value: 0\n",
            "- class: 0\n  value: 0\n",
            "- class: [\n",
            "hello",
        ] {
            let error = parse_annotations(broken.as_bytes(), 2).unwrap_err();
            assert!(error.line().is_some(), "{broken:?}: {error}");
        }
        assert!(parse_annotations(&[0xff, 0xfe, 0xfd], 1).is_err());
    }

    #[test]
    fn a_mapping_has_no_gaps() {
        assert_eq!(parse_mapping(b"0: AU01\n1: AU45\n").unwrap(), ["AU01", "AU45"]);
        assert_eq!(parse_mapping(b"{1: b, 0: a}").unwrap(), ["a", "b"]);
        assert!(parse_mapping(b"").unwrap().is_empty());
        assert!(parse_mapping(b"0: a\n2: b\n").unwrap_err().to_string().contains("class 1"));
        assert!(parse_mapping(b"0: a\n0: b\n").is_err());
    }

    #[test]
    fn what_older_readers_take_for_something_else_is_avoided() {
        let text = annotations_text(&[
            Annotation { class: 0, frame: 1, value: 1e-7 },
            Annotation { class: 0, frame: 2, value: -1.0 },
        ]);
        assert!(text.contains("value: 0.0000001\n") && text.contains("value: -1.0\n"), "{text}");
        let names = ["AU01", "yes", "no", "1e5", "a: b", "\"", "", "1_0", "E123"].map(str::to_owned);
        let text = mapping_text(&names);
        assert!(text.starts_with("0: AU01\n1: \"yes\"\n"), "{text}");
        assert_eq!(parse_mapping(text.as_bytes()).unwrap(), names);
    }

    #[test]
    fn a_long_video_fits_the_limits() {
        let many: Vec<_> =
            (0..60_000).map(|i| Annotation { class: i % 17, frame: i as u32 / 17, value: 0.25 }).collect();
        assert_eq!(parse_annotations(annotations_text(&many).as_bytes(), 17).unwrap(), many);
    }

    proptest! {
        #[test]
        fn annotations_come_back(values in prop::collection::vec((0usize..17, any::<u32>(), -1f32..=1.0), 0..20)) {
            let all: Vec<_> = values.into_iter().map(|(class, frame, value)| Annotation { class, frame, value }).collect();
            prop_assert_eq!(parse_annotations(annotations_text(&all).as_bytes(), 17).unwrap(), all);
        }

        #[test]
        fn names_come_back(names in prop::collection::vec("[ -~]{0,12}", 0..6)) {
            prop_assert_eq!(parse_mapping(mapping_text(&names).as_bytes()).unwrap(), names);
        }

        #[test]
        fn nothing_makes_the_parsers_panic(bytes in prop::collection::vec(any::<u8>(), 0..120), text in "[-\\[\\]{}:,&*!|>'\"#%@ \n0-9a-f.]{0,80}") {
            for input in [&bytes[..], text.as_bytes()] {
                let _ = parse_annotations(input, 3);
                let _ = parse_mapping(input);
            }
        }
    }
}
