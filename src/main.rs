//! The `acquire` program; everything is in the library.

fn main() -> std::process::ExitCode {
    acquire::cli::main()
}
