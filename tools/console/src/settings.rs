//! `risorius.toml`: defaults of a project, found in the current folder or one above it.

use std::fmt;
use std::marker::PhantomData;
use std::path::{Path, PathBuf};

use serde::de::{DeserializeOwned, DeserializeSeed, IgnoredAny, MapAccess, Visitor};

use crate::Failure;

/// The name of the settings file.
pub const SETTINGS_FILE: &str = "risorius.toml";

/// The `[table]` of `risorius.toml` in the current folder or the nearest folder above that has one.
///
/// Defaults where the file or the table is absent; whether unknown keys are errors is up to `T`.
pub fn settings<T: DeserializeOwned + Default>(table: &str) -> Result<T, Failure> {
    // A current folder that is gone has no settings.
    std::env::current_dir().map_or_else(|_| Ok(T::default()), |dir| settings_from(&dir, table))
}

/// The same as [`settings`], starting at `dir` instead of the current folder.
pub fn settings_from<T: DeserializeOwned + Default>(dir: &Path, table: &str) -> Result<T, Failure> {
    let Some(path) = find(dir) else { return Ok(T::default()) };
    let text =
        std::fs::read_to_string(&path).map_err(|e| Failure::input(format!("{}: cannot read: {e}", path.display())))?;
    let fail = |e: &toml::de::Error| {
        let line = e.span().map(|s| 1 + text.bytes().take(s.start).filter(|&b| b == b'\n').count());
        let place = line.map_or_else(|| path.display().to_string(), |line| format!("{}:{line}", path.display()));
        Failure::input(format!("{place}: {}", e.message().trim().replace('\n', ", ")))
            .with_hint(format!("the table `[{table}]` takes the long options of the command as keys"))
    };
    let document = toml::Deserializer::parse(&text).map_err(|e| fail(&e))?;
    let seed = OneTable { name: table, kind: PhantomData::<T> };
    Ok(seed.deserialize(document).map_err(|e| fail(&e))?.unwrap_or_default())
}

fn find(dir: &Path) -> Option<PathBuf> {
    dir.ancestors().map(|d| d.join(SETTINGS_FILE)).find(|p| p.is_file())
}

/// Deserialises one table straight from the text, so that errors know their line, and skips the others.
struct OneTable<'a, T> {
    name: &'a str,
    kind: PhantomData<T>,
}

impl<'de, T: DeserializeOwned> DeserializeSeed<'de> for OneTable<'_, T> {
    type Value = Option<T>;

    fn deserialize<D: serde::Deserializer<'de>>(self, deserializer: D) -> Result<Self::Value, D::Error> {
        deserializer.deserialize_map(self)
    }
}

impl<'de, T: DeserializeOwned> Visitor<'de> for OneTable<'_, T> {
    type Value = Option<T>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "a settings file")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Self::Value, A::Error> {
        let mut found = None;
        while let Some(key) = map.next_key::<String>()? {
            if key == self.name {
                found = Some(map.next_value()?);
            } else {
                map.next_value::<IgnoredAny>()?;
            }
        }
        Ok(found)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(serde::Deserialize, Default, Debug, PartialEq)]
    #[serde(deny_unknown_fields, default)]
    struct Demo {
        link: bool,
        fps: Option<f64>,
    }

    fn demo(text: &str) -> Result<Demo, Failure> {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join(SETTINGS_FILE), text).unwrap();
        let deep = dir.path().join("a/b");
        std::fs::create_dir_all(&deep).unwrap();
        settings_from(&deep, "demo")
    }

    #[test]
    fn the_nearest_file_above_counts() {
        assert_eq!(demo("[other]\nx = 1\n[demo]\nfps = 60.0\n").unwrap(), Demo { link: false, fps: Some(60.0) });
        assert_eq!(demo("[other]\nx = 1\n").unwrap(), Demo::default());
    }

    #[test]
    fn mistakes_name_the_line() {
        for (text, line, word) in [
            ("[demo]\n\nfsp = 60.0\n", ":3:", "fsp"),
            ("[demo]\nlink = true\nfps = \"many\"\n", ":3:", "string"),
            ("[demo]\nlink = \n", ":2:", ""),
        ] {
            let failure = demo(text).unwrap_err();
            assert!(failure.message().contains(line) && failure.message().contains(word), "{failure:?}");
            assert_eq!(failure.status(), 1);
        }
    }
}
