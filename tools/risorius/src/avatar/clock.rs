//! Wall and CPU time of a stage.

use std::time::Instant;

/// Ticks of the kernel's counters per second, the same on every Linux that is in use.
const TICKS_PER_SEC: f64 = 100.0;

/// A running measurement.
#[derive(Clone, Copy, Debug)]
pub(super) struct Clock {
    begun: Instant,
    cpu: Option<f64>,
}

impl Clock {
    pub(super) fn start() -> Self {
        Self { begun: Instant::now(), cpu: cpu_secs() }
    }

    pub(super) fn wall_secs(&self) -> f64 {
        self.begun.elapsed().as_secs_f64()
    }

    /// CPU time of this process and of its children that ended, such as COLMAP; `None` where the system does not tell.
    pub(super) fn cpu_secs(&self) -> Option<f64> {
        Some(cpu_secs()? - self.cpu?)
    }
}

/// `utime`, `stime`, `cutime` and `cstime` of `/proc/self/stat`.
fn cpu_secs() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/self/stat").ok()?;
    // The name in parentheses may hold anything.
    let fields: Vec<&str> = text.rsplit_once(')')?.1.split_whitespace().collect();
    let ticks = fields.get(11..15)?.iter().map(|f| f.parse::<f64>().ok()).sum::<Option<f64>>()?;
    Some(ticks / TICKS_PER_SEC)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_takes_cpu_time() {
        let clock = Clock::start();
        let mut sum = 0u64;
        while clock.wall_secs() < 0.2 {
            sum = sum.wrapping_mul(31).wrapping_add(1);
        }
        assert!(sum != 1);
        if let Some(cpu) = clock.cpu_secs() {
            assert!(cpu > 0.02 && cpu < 60.0, "{cpu}");
        }
    }
}
