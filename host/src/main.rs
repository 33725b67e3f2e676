//! The command `occlude`: see `occlude_host::cli`.

use std::process::ExitCode;

/// Trees of a million triangles and more are built in two thirds of the time: what one step gives back the next takes,
/// and need not ask the system for again, page by page.
#[cfg(feature = "mimalloc")]
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    occlude_host::cli::run()
}
