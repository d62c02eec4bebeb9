//! Outputs, by one rule for all of them.
//!
//! - An output is made under a temporary name beside its place and put there in one step when it is whole and on the
//!   disk ([`place`]): at every instant the earlier or the new one is there.
//! - Nothing is replaced but what this program has made and nobody has changed since: a folder by its record
//!   ([`NewFolder`]), a file by the seal in it ([`seal`]), a matrix by its own checksum. Whether it *may* be replaced
//!   (`--force`) is the caller's to ask.
//! - No output lies in an input, or has one in it ([`check_apart`]).
//! - What a stopped run has left is removed: at once on signals ([`remove_on_signals`]), else by the next run that
//!   writes beside it, or by `acquire clean` ([`remove_leftovers`]); but for work that can be gone on with
//!   ([`WorkLog`]), which waits for the next run for the same output.
//! - Files of tasks that run beside each other on many machines need no lock ([`Unlocked`]).

mod apart;
mod file;
mod folder;
mod leftovers;
mod place;
mod scratch;
mod seal;
mod signals;
mod task_file;
mod unlocked;
mod work_log;

pub(crate) use apart::check_apart;
pub(crate) use file::{check_file, write_whole};
pub(crate) use folder::{NewFolder, PROGRAM};
pub(crate) use leftovers::{remove_leftovers, take_kept, take_removed};
pub(crate) use place::put;
pub(crate) use scratch::ScratchFolder;
pub(crate) use seal::{SEAL, seal};
pub(crate) use signals::remove_on_signals;
pub(crate) use task_file::{TaskFile, numbers};
pub(crate) use unlocked::{Unlocked, begins_with, check_by_head, is_unfinished};
pub(crate) use work_log::{Earlier, WorkLog, checked_lines, key_of, write_line};
