//! What is unfinished when a signal ends the program.

use super::scratch::LOCK;
use crate::{Error, Result};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard};

/// What is to be removed when a signal ends the program.
static UNFINISHED: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());

/// A scratch folder, or a file under a temporary name, that a signal removes, until this is dropped.
#[derive(Debug)]
pub(super) struct Unfinished(PathBuf);

impl Unfinished {
    pub(super) fn new(path: &Path) -> Self {
        let path = std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf());
        list().insert(path.clone());
        Self(path)
    }
}

impl Drop for Unfinished {
    fn drop(&mut self) {
        list().remove(&self.0);
    }
}

fn list() -> MutexGuard<'static, BTreeSet<PathBuf>> {
    UNFINISHED.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

/// Until this is dropped, a signal waits.
pub(super) fn hold() -> MutexGuard<'static, BTreeSet<PathBuf>> {
    list()
}

#[cfg(test)]
pub(super) fn is_listed(path: &Path) -> bool {
    list().contains(path)
}

/// From now on Ctrl-C removes what is unfinished before it ends the program.
///
/// # Errors
/// [`Error::Internal`] when the system refuses the handler.
#[cfg(not(unix))]
pub(crate) fn remove_on_signals() -> Result<()> {
    let end = || {
        list().iter().for_each(|path| remove(path));
        std::process::exit(130);
    };
    ctrlc::set_handler(end).map_err(Error::internal)
}

/// From now on Ctrl-C, SIGTERM and SIGHUP (a terminal that is closed) remove what is unfinished before they end the
/// program, as they would have without this. Those that were ignored when the program began, by `nohup` say, stay so.
///
/// # Errors
/// [`Error::Internal`] when the system refuses the handlers.
#[cfg(unix)]
pub(crate) fn remove_on_signals() -> Result<()> {
    use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
    let ignored = ignored_signals();
    let heeded = [SIGINT, SIGTERM, SIGHUP].into_iter().filter(|s| ignored >> (s - 1) & 1 == 0);
    let mut signals = signal_hook::iterator::Signals::new(heeded).map_err(Error::internal)?;
    std::thread::spawn(move || {
        for signal in signals.forever() {
            // Held until the end: the threads at work meet missing files, and wait here instead of reporting them.
            let unfinished = list();
            for path in unfinished.iter() {
                remove(path);
            }
            let _ = signal_hook::low_level::emulate_default_handler(signal);
        }
    });
    Ok(())
}

/// The signals that this process was started to ignore, signal s as bit s − 1; none where the system does not tell.
#[cfg(unix)]
fn ignored_signals() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).unwrap_or(0)
}

/// Removes a scratch folder, its lock last: without it nobody could tell that the rest is ours. Of a file, the file.
pub(super) fn remove(folder: &Path) {
    if folder.is_file() {
        let _ = std::fs::remove_file(folder);
        return;
    }
    // Other threads may still add files while the folder is emptied.
    for _ in 0..20 {
        let Ok(entries) = std::fs::read_dir(folder) else { return };
        for entry in entries.flatten().filter(|e| e.file_name() != LOCK) {
            let _ = match entry.file_type().is_ok_and(|kind| kind.is_dir()) {
                true => std::fs::remove_dir_all(entry.path()),
                false => std::fs::remove_file(entry.path()),
            };
        }
        if std::fs::read_dir(folder).is_ok_and(|rest| rest.flatten().all(|e| e.file_name() == LOCK)) {
            let _ = std::fs::remove_file(folder.join(LOCK));
            let _ = std::fs::remove_dir(folder);
            return;
        }
    }
}
