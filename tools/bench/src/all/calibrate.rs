//! A fixed piece of work whose CPU time is the unit of cost: arithmetic that stays in registers, sums over a table that
//! fits the second-level cache, and look-ups in one that does not.

/// Numbers in the larger table: 32 MiB.
const LARGE: usize = 1 << 23;
/// Numbers in the smaller table: 256 KiB.
const SMALL: usize = 1 << 16;

/// Does the work; the sum is printed so that nothing of it can be left out.
pub(crate) fn work() -> f64 {
    let table: Vec<f32> = (0..LARGE).map(|i| (i % 1013) as f32 * 1e-3).collect();
    let mut sum = 0.0f64;
    // Look-ups, each of which depends on the one before.
    let mut at = 1usize;
    for _ in 0..6_000_000 {
        at = at.wrapping_mul(0x5DEE_CE66).wrapping_add(table[at & (LARGE - 1)] as usize + 11);
        sum += f64::from(table[(at >> 7) & (LARGE - 1)]);
    }
    for round in 0..1500 {
        let factor = 1.0 + round as f32 * 1e-6;
        let part: f32 = table[..SMALL].iter().map(|v| v * factor).sum();
        sum += f64::from(part) * 1e-6;
    }
    let (mut x, mut y) = (0.5f64, 0.25f64);
    for _ in 0..60_000_000 {
        x = x.mul_add(0.999_999, 1e-7);
        y = y.mul_add(0.999_998, 2e-7);
    }
    sum + x + y
}

/// What the processor calls itself.
pub(crate) fn processor() -> String {
    let text = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = text.lines().find_map(|line| line.strip_prefix("model name")?.split_once(':'));
    name.map_or_else(|| "unknown".to_owned(), |(_, name)| name.trim().to_owned())
}
