//! What is unfinished when a signal ends the program.

use super::scratch::LOCK;
use crate::{Error, Result};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard};
use std::time::{Duration, Instant};

/// What is to be removed when a signal ends the program.
static UNFINISHED: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());

/// A scratch folder, or a file under a temporary name, that a signal removes, until this is dropped.
#[derive(Debug)]
pub(super) struct Unfinished(PathBuf);

impl Unfinished {
    /// Of a path that is there already.
    pub(super) fn new(path: &Path) -> Self {
        Self::listed(&mut list(), path)
    }

    /// Of the path that `make` makes, if it makes one: no signal comes between making and knowing it.
    pub(super) fn made<T>(
        make: impl FnOnce() -> std::io::Result<Option<T>>,
        path: impl FnOnce(&T) -> &Path,
    ) -> std::io::Result<Option<(Self, T)>> {
        let mut list = list();
        let Some(made) = make()? else { return Ok(None) };
        Ok(Some((Self::listed(&mut list, path(&made)), made)))
    }

    fn listed(list: &mut BTreeSet<PathBuf>, path: &Path) -> Self {
        let path = std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf());
        list.insert(path.clone());
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
    // Other threads may still add files while the folder is emptied: what has been moved aside they no longer find, but
    // they may make a folder anew that is missing.
    let began = Instant::now();
    for n in 0.. {
        let Ok(entries) = std::fs::read_dir(folder) else { return };
        let rest: Vec<_> = entries.flatten().filter(|e| e.file_name() != LOCK).collect();
        if rest.is_empty() {
            let _ = std::fs::remove_file(folder.join(LOCK));
            let _ = std::fs::remove_dir(folder);
            return;
        }
        if began.elapsed() > LONGEST {
            return;
        }
        for (i, entry) in rest.iter().enumerate() {
            let aside = folder.join(format!("removed-{n}-{i}"));
            let path = if std::fs::rename(entry.path(), &aside).is_ok() { aside } else { entry.path() };
            let _ = match path.is_dir() && !path.is_symlink() {
                true => std::fs::remove_dir_all(path),
                false => std::fs::remove_file(path),
            };
        }
    }
}

/// Longer than this nothing is removed: a file system that fails would keep the program from ending.
const LONGEST: Duration = Duration::from_secs(20);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_is_removed_while_other_threads_add_files() {
        for _ in 0..20 {
            let parent = tempfile::tempdir().unwrap();
            let folder = parent.path().join("scratch");
            let busy = folder.join("new/c/0");
            std::fs::create_dir_all(&busy).unwrap();
            std::fs::write(folder.join(LOCK), "").unwrap();
            std::thread::scope(|scope| {
                for thread in 0..4 {
                    let busy = &busy;
                    // As threads at work do, which wait at their first error.
                    scope.spawn(move || (0..).all(|i| std::fs::write(busy.join(format!("{thread}-{i}")), "x").is_ok()));
                }
                std::thread::sleep(Duration::from_millis(5));
                remove(&folder);
            });
            assert!(!folder.exists());
        }
    }
}
