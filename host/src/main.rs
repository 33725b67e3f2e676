//! The command `occlude`: see `occlude_host::cli`.

use std::process::ExitCode;

fn main() -> ExitCode {
    occlude_host::cli::run()
}
