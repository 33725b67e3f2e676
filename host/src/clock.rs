//! Time spent working: what else the machine does meanwhile is not in it.
//!
//! CPU time where the system tells (Linux), time on the clock elsewhere.

use std::time::Duration;

/// Of this thread, since some fixed moment.
pub fn of_thread() -> Duration {
    #[cfg(target_os = "linux")]
    return read(rustix::time::ClockId::ThreadCPUTime);
    #[cfg(not(target_os = "linux"))]
    elapsed()
}

/// Of all threads together.
pub fn of_process() -> Duration {
    #[cfg(target_os = "linux")]
    return read(rustix::time::ClockId::ProcessCPUTime);
    #[cfg(not(target_os = "linux"))]
    elapsed()
}

#[cfg(target_os = "linux")]
fn read(clock: rustix::time::ClockId) -> Duration {
    let time = rustix::time::clock_gettime(clock);
    Duration::new(time.tv_sec.unsigned_abs(), time.tv_nsec.unsigned_abs() as u32)
}

#[cfg(not(target_os = "linux"))]
fn elapsed() -> Duration {
    static FIRST: std::sync::OnceLock<std::time::Instant> = std::sync::OnceLock::new();
    FIRST.get_or_init(std::time::Instant::now).elapsed()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_takes_time() {
        let (thread, process) = (of_thread(), of_process());
        let mut sum = 0u64;
        while of_thread() < thread + Duration::from_millis(2) {
            sum = std::hint::black_box(sum + 1);
        }
        assert!(of_process() > process);
    }
}
