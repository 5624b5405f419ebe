//! What a process uses of the machine, from Linux' /proc.

use std::fs;
use std::time::Duration;

use anyhow::{Context, Result};

/// Clock ticks a second in /proc/PID/stat: USER_HZ, 100 on every architecture this runs on.
const TICKS_PER_SECOND: u64 = 100;

/// Memory of a process, bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Memory {
    /// Resident now.
    pub resident: u64,
    /// Most that was ever resident.
    pub peak: u64,
}

/// Memory of process `pid`.
///
/// # Errors
/// When there is no such process.
pub fn memory(pid: u32) -> Result<Memory> {
    let path = format!("/proc/{pid}/status");
    let status = fs::read_to_string(&path).with_context(|| path.clone())?;
    let field = |name: &str| {
        let line = status.lines().find_map(|line| line.strip_prefix(name));
        let kilobytes = line.and_then(|rest| rest.trim_end_matches("kB").trim().parse::<u64>().ok());
        kilobytes.map(|kilobytes| kilobytes * 1024).with_context(|| format!("{path}: no {name} line; has the process ended?"))
    };
    Ok(Memory { resident: field("VmRSS:")?, peak: field("VmHWM:")? })
}

/// Time that all threads of process `pid` have spent computing, user and system.
///
/// # Errors
/// When there is no such process.
pub fn cpu_time(pid: u32) -> Result<Duration> {
    let path = format!("/proc/{pid}/stat");
    let stat = fs::read_to_string(&path).with_context(|| path.clone())?;
    // Field 2 is the program's name in parentheses and may hold anything; 14 and 15 are user and system time.
    let after_name = stat.rsplit_once(')').map(|(_, rest)| rest).unwrap_or_default();
    let mut ticks = after_name.split_whitespace().skip(11).map(str::parse::<u64>);
    match (ticks.next(), ticks.next()) {
        (Some(Ok(user)), Some(Ok(system))) => Ok(Duration::from_millis((user + system) * 1000 / TICKS_PER_SECOND)),
        _ => anyhow::bail!("{path}: no CPU times"),
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::*;

    #[test]
    fn own_memory_grows_with_what_is_written() {
        let before = memory(std::process::id()).unwrap();
        let written = std::hint::black_box(vec![1_u8; 64 << 20]);
        let after = memory(std::process::id()).unwrap();
        assert!(after.peak >= before.resident + written.len() as u64 / 2, "{before:?} {after:?}");
    }

    #[test]
    fn own_cpu_time_rises() {
        let before = cpu_time(std::process::id()).unwrap();
        let (mut x, deadline) = (1_u64, Instant::now() + Duration::from_secs(60));
        while cpu_time(std::process::id()).unwrap() < before + Duration::from_millis(50) {
            assert!(Instant::now() < deadline, "a minute of computing does not show");
            x = std::hint::black_box(x.wrapping_mul(3));
        }
    }

    #[test]
    fn a_process_that_is_not_there_is_named() {
        assert!(memory(u32::MAX).unwrap_err().to_string().contains("/proc/4294967295/status"));
        assert!(cpu_time(u32::MAX).unwrap_err().to_string().contains("/proc/4294967295/stat"));
    }
}
