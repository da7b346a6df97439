#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    if let Some((choice, bytes)) = data.split_first() {
        risorius_fuzz::colmap(*choice, bytes);
    }
});
