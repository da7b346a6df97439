//! Which devices this build can compute on, and which of them are here.

use burn::tensor::{DType, Device};
use serde::Serialize;

use crate::error::{Result, TrainerError};
use crate::kernel::Products;

/// A sort of device.
#[derive(Clone, Debug, Serialize)]
pub struct DeviceKind {
    /// As `--device` takes it.
    pub name: &'static str,
    /// Whether it is in this build.
    pub compiled_in: bool,
    /// Those that are here.
    pub present: Vec<String>,
    /// What the build lacks, or what was found wanting.
    pub note: String,
}

/// All sorts of devices that there are builds for.
pub fn list() -> Vec<DeviceKind> {
    vec![cpu(), cuda(), wgpu()]
}

/// The device of this name.
pub fn open(name: &str) -> Result<Device> {
    let fail = |message: &str, hint: String| TrainerError::Device {
        device: name.to_owned(),
        message: message.to_owned(),
        hint,
    };
    let Some(kind) = list().into_iter().find(|k| k.name == name) else {
        return Err(fail("is not known", "devices: cpu, cuda, wgpu; see `trainer devices`".to_owned()));
    };
    if !kind.compiled_in {
        let hint =
            format!("use `--device cpu`, or build with `cargo build --release --features risorius-trainer/{name}`");
        return Err(fail("is not in this build", hint));
    }
    if kind.present.is_empty() {
        return Err(fail("is not here", format!("{}; use `--device cpu`", kind.note)));
    }
    match name {
        #[cfg(feature = "cuda")]
        "cuda" => Ok(Device::cuda(0usize)),
        #[cfg(feature = "wgpu")]
        "wgpu" => Ok(Device::wgpu(burn::tensor::DeviceKind::DefaultDevice)),
        _ => Ok(Device::flex()),
    }
}

/// Whether the device knows the numbers that a model's products want.
///
/// # Errors
/// [`TrainerError::Device`] where it does not.
pub fn check(device: &Device, products: Products) -> Result<()> {
    if products == Products::Bf16 && !device.supports_dtype(DType::BF16) {
        return Err(TrainerError::Device {
            device: format!("{device:?}"),
            message: "knows no bfloat16".to_owned(),
            hint: "leave out `--set 'model.products=\"bf16\"'`".to_owned(),
        });
    }
    Ok(())
}

fn cpu() -> DeviceKind {
    let threads = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    DeviceKind {
        name: "cpu",
        compiled_in: true,
        present: vec![format!("{threads} threads, {}", vectors())],
        note: "fused kernels of this project on Burn's Flex backend".to_owned(),
    }
}

#[cfg(target_arch = "x86_64")]
fn vectors() -> &'static str {
    if is_x86_feature_detected!("avx512f") {
        "AVX-512"
    } else if is_x86_feature_detected!("avx2") {
        "AVX2"
    } else {
        "SSE2"
    }
}

#[cfg(not(target_arch = "x86_64"))]
fn vectors() -> &'static str {
    std::env::consts::ARCH
}

#[cfg(not(feature = "cuda"))]
fn cuda() -> DeviceKind {
    absent("cuda")
}

#[cfg(not(feature = "wgpu"))]
fn wgpu() -> DeviceKind {
    absent("wgpu")
}

#[cfg(not(all(feature = "cuda", feature = "wgpu")))]
fn absent(name: &'static str) -> DeviceKind {
    let note = format!("build with `--features risorius-trainer/{name}`");
    DeviceKind { name, compiled_in: false, present: Vec::new(), note }
}

#[cfg(feature = "cuda")]
fn cuda() -> DeviceKind {
    found("cuda", burn::tensor::DeviceType::Cuda, "no CUDA driver or no device")
}

#[cfg(feature = "wgpu")]
fn wgpu() -> DeviceKind {
    found("wgpu", burn::tensor::DeviceType::Wgpu, "no Vulkan, Metal or DirectX adapter")
}

#[cfg(any(feature = "cuda", feature = "wgpu"))]
fn found(name: &'static str, kind: burn::tensor::DeviceType, none: &str) -> DeviceKind {
    // Drivers that are not there make the backends panic rather than say so.
    let listed = std::panic::catch_unwind(|| Device::enumerate(kind).iter().map(|d| format!("{d:?}")).collect());
    let present: Vec<String> = listed.unwrap_or_default();
    let note = if present.is_empty() { none.to_owned() } else { "plain operations of Burn".to_owned() };
    DeviceKind { name, compiled_in: true, present, note }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cpu_is_always_there_and_others_are_refused_with_a_hint() {
        let all = list();
        assert_eq!(all.iter().map(|k| k.name).collect::<Vec<_>>(), ["cpu", "cuda", "wgpu"]);
        assert!(all[0].compiled_in && all[0].present.len() == 1);
        assert!(open("cpu").is_ok());
        for kind in all.iter().filter(|k| k.present.is_empty()) {
            assert!(matches!(open(kind.name), Err(TrainerError::Device { .. })), "{}", kind.name);
        }
        assert!(matches!(open("abacus"), Err(TrainerError::Device { .. })));
    }
}
