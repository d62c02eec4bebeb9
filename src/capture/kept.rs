//! Decoded photographs that are kept in memory, because several stages read them: decoding is most of the time that a
//! build takes.

use super::Pixels;
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Decoded photographs of one capture, kept while their sizes together stay below a limit, which is 0 bytes until `allow`
/// sets it.
///
/// Clones share them. A file that changes after it was read is not noticed.
#[derive(Debug, Clone, Default)]
pub struct Kept(Arc<Mutex<Store>>);

#[derive(Debug, Default)]
struct Store {
    most_bytes: usize,
    /// Of what is held, and of what is being read to be held.
    bytes: usize,
    /// By file and pixels along a side of the blocks that were averaged.
    held: HashMap<(PathBuf, usize), Arc<Pixels>>,
}

/// A photograph of more than this share of all that may be kept is not: so few of them save nothing.
const LARGEST_SHARE: usize = 16;

impl Kept {
    /// From now on so many bytes may be kept.
    pub(crate) fn allow(&self, most_bytes: usize) {
        self.store().most_bytes = most_bytes;
    }

    /// Forgets what was kept.
    pub(crate) fn forget(&self) {
        let mut store = self.store();
        let held: usize = store.held.drain().map(|(_, pixels)| pixels.samples.bytes()).sum();
        store.bytes -= held;
    }

    /// Forgets a file in whatever resolution.
    pub(crate) fn forget_file(&self, path: &Path) {
        let store = &mut *self.store();
        let of_file = store.held.extract_if(|(held, _), _| held == path);
        store.bytes -= of_file.map(|(_, pixels)| pixels.samples.bytes()).sum::<usize>();
    }

    pub(super) fn get(&self, path: &Path, factor: usize) -> Option<Arc<Pixels>> {
        let store = self.store();
        // Most captures of large photographs keep few: no path is copied for a miss.
        if store.held.is_empty() {
            return None;
        }
        store.held.get(&(path.to_owned(), factor)).cloned()
    }

    /// Reserves `bytes` for one photograph; `None` when they do not fit.
    pub(super) fn room(&self, bytes: usize) -> Option<Room> {
        let mut store = self.store();
        let fits = bytes <= store.most_bytes / LARGEST_SHARE && store.bytes + bytes <= store.most_bytes;
        fits.then(|| {
            store.bytes += bytes;
            Room { kept: self.clone(), bytes }
        })
    }

    fn store(&self) -> MutexGuard<'_, Store> {
        // What is in it is whole at any time.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Where photographs are kept makes no difference between them.
impl PartialEq for Kept {
    fn eq(&self, _: &Self) -> bool {
        true
    }
}

/// Bytes that are set aside for one photograph, until it is there or given up.
#[derive(Debug)]
pub(super) struct Room {
    kept: Kept,
    bytes: usize,
}

impl Room {
    /// Keeps a photograph, if it is no larger than what was set aside and another thread was not first.
    pub(super) fn put(mut self, path: &Path, factor: usize, pixels: Arc<Pixels>) {
        let bytes = pixels.samples.bytes();
        let mut store = self.kept.store();
        if bytes <= self.bytes && !store.held.contains_key(&(path.to_owned(), factor)) {
            store.held.insert((path.to_owned(), factor), pixels);
            self.bytes -= bytes;
        }
    }
}

impl Drop for Room {
    fn drop(&mut self) {
        self.kept.store().bytes -= self.bytes;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::{Samples, Sampling};

    fn pixels(side: usize) -> Arc<Pixels> {
        let samples = Samples::U16(vec![7; 3 * side * side]);
        Arc::new(Pixels { width: side, height: side, samples, sampling: Sampling::WHOLE })
    }

    #[test]
    fn photographs_are_kept_as_they_come_while_there_is_room() {
        let kept = Kept::default();
        assert!(kept.room(1).is_none(), "nothing is allowed");
        // Twenty of 600 bytes.
        kept.allow(20 * 600 + 599);
        let put = |k: usize| kept.room(600).map(|room| room.put(Path::new(&k.to_string()), 1, pixels(10)));
        assert_eq!((0..30).filter_map(put).count(), 20);
        assert!(kept.get(Path::new("19"), 1).is_some() && kept.get(Path::new("20"), 1).is_none());
        assert!(kept.get(Path::new("19"), 2).is_none(), "another resolution is another picture");
        // Clones share; what is forgotten leaves its room.
        kept.clone().forget();
        assert!(kept.get(Path::new("19"), 1).is_none());
        assert_eq!((0..30).filter_map(put).count(), 20);
        kept.forget_file(Path::new("7"));
        assert!(kept.get(Path::new("7"), 1).is_none() && kept.get(Path::new("8"), 1).is_some());
        assert_eq!((30..40).filter_map(put).count(), 1);
        assert!(kept.room(1201).is_none(), "more than a sixteenth of all");
    }

    #[test]
    fn what_is_given_up_or_larger_than_it_said_leaves_its_room() {
        let kept = Kept::default();
        kept.allow(16 * 600);
        let all = || (0..16).map(|_| kept.room(600)).collect::<Option<Vec<_>>>();
        assert!(all().is_some() && all().is_some());
        kept.room(599).unwrap().put(Path::new("a"), 1, pixels(10));
        assert!(kept.get(Path::new("a"), 1).is_none() && all().is_some());
        // A second one of the same name takes no room.
        for _ in 0..2 {
            kept.room(600).unwrap().put(Path::new("a"), 1, pixels(10));
        }
        assert!(all().is_none() && (0..15).map(|_| kept.room(600)).collect::<Option<Vec<_>>>().is_some());
        // Smaller than it said: what is left over is free.
        kept.room(600).unwrap().put(Path::new("b"), 1, pixels(5));
        assert!((0..14).map(|_| kept.room(600)).collect::<Option<Vec<_>>>().is_some());
        assert!(kept.room(450).is_some());
    }
}
