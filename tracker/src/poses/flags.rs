//! Names of COLMAP's options, which change between its versions.

/// A COLMAP version.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Version {
    /// The first number.
    pub major: u32,
    /// The second number.
    pub minor: u32,
}

impl Version {
    /// Finds `COLMAP 3.8` or `COLMAP 3.13.0.dev0` in the program's help.
    pub fn find(text: &str) -> Option<Self> {
        text.match_indices("COLMAP ").find_map(|(at, word)| {
            let mut numbers = text[at + word.len()..].split(|c: char| !c.is_ascii_digit());
            Some(Self { major: numbers.next()?.parse().ok()?, minor: numbers.next()?.parse().ok()? })
        })
    }
}

impl std::fmt::Display for Version {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}.{}", self.major, self.minor)
    }
}

/// Options whose names differ.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Flags {
    /// Feature extraction on the graphics card.
    pub extraction_gpu: &'static str,
    /// Feature matching on the graphics card.
    pub matching_gpu: &'static str,
    /// Growth of the model that calls for a global adjustment.
    pub global_ratio: &'static str,
}

impl Flags {
    /// The names in `version`; an unknown version is taken for a new one.
    pub fn of(version: Option<Version>) -> Self {
        let before = |major, minor| version.is_some_and(|v| v < Version { major, minor });
        // 3.13 knows other features than SIFT; 3.12 counts in rig frames instead of images.
        let sift = before(3, 13);
        Self {
            extraction_gpu: if sift { "--SiftExtraction.use_gpu" } else { "--FeatureExtraction.use_gpu" },
            matching_gpu: if sift { "--SiftMatching.use_gpu" } else { "--FeatureMatching.use_gpu" },
            global_ratio: if before(3, 12) {
                "--Mapper.ba_global_images_ratio"
            } else {
                "--Mapper.ba_global_frames_ratio"
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn versions_are_found_in_the_help() {
        let find = |text| Version::find(text).map(|v| (v.major, v.minor));
        assert_eq!(find("COLMAP 3.8 -- Structure-from-Motion and Multi-View Stereo\n"), Some((3, 8)));
        assert_eq!(find("I2025 COLMAP 3.13.0.dev0 (Commit 1ab on 2025-11-07 with CUDA)"), Some((3, 13)));
        assert_eq!(find("warning\nUsing COLMAP here\nCOLMAP 4.1.0 -- x"), Some((4, 1)));
        assert_eq!(find("usage: something else"), None);
        assert_eq!(find("COLMAP "), None);
    }

    #[test]
    fn names_change_at_3_12_and_3_13() {
        let of = |major, minor| Flags::of(Some(Version { major, minor }));
        for minor in [6, 8, 9, 10, 12] {
            assert_eq!(of(3, minor).extraction_gpu, "--SiftExtraction.use_gpu", "3.{minor}");
            assert_eq!(of(3, minor).matching_gpu, "--SiftMatching.use_gpu", "3.{minor}");
        }
        for (major, minor) in [(3, 13), (4, 0), (4, 1)] {
            assert_eq!(of(major, minor).extraction_gpu, "--FeatureExtraction.use_gpu");
            assert_eq!(of(major, minor).matching_gpu, "--FeatureMatching.use_gpu");
        }
        assert_eq!(of(3, 11).global_ratio, "--Mapper.ba_global_images_ratio");
        assert_eq!(of(3, 12).global_ratio, "--Mapper.ba_global_frames_ratio");
        assert_eq!(Flags::of(None), of(4, 1));
    }
}
