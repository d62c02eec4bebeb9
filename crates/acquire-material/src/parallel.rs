//! Loops over many rows: on all cores with the feature `threads`, else one after the other by the same names.

#[cfg(feature = "threads")]
pub(crate) use rayon::prelude::*;

#[cfg(not(feature = "threads"))]
pub(crate) use one_by_one::*;

#[cfg(not(feature = "threads"))]
#[allow(dead_code, reason = "some are only for coded files")]
mod one_by_one {
    pub(crate) trait IntoParallelIterator: IntoIterator + Sized {
        fn into_par_iter(self) -> Self::IntoIter {
            self.into_iter()
        }
    }

    impl<I: IntoIterator> IntoParallelIterator for I {}

    pub(crate) trait ParallelSlice<T> {
        fn par_iter(&self) -> std::slice::Iter<'_, T>;
        fn par_chunks(&self, len: usize) -> std::slice::Chunks<'_, T>;
        fn par_chunks_mut(&mut self, len: usize) -> std::slice::ChunksMut<'_, T>;
    }

    impl<T> ParallelSlice<T> for [T] {
        fn par_iter(&self) -> std::slice::Iter<'_, T> {
            self.iter()
        }

        fn par_chunks(&self, len: usize) -> std::slice::Chunks<'_, T> {
            self.chunks(len)
        }

        fn par_chunks_mut(&mut self, len: usize) -> std::slice::ChunksMut<'_, T> {
            self.chunks_mut(len)
        }
    }

    pub(crate) trait ParallelIterator: Iterator + Sized {
        fn for_each_init<S>(self, init: impl Fn() -> S, each: impl Fn(&mut S, Self::Item)) {
            let mut state = init();
            self.for_each(|item| each(&mut state, item));
        }

        fn try_for_each_init<S, E>(
            self,
            init: impl Fn() -> S,
            each: impl Fn(&mut S, Self::Item) -> Result<(), E>,
        ) -> Result<(), E> {
            let mut state = init();
            let mut items = self;
            items.try_for_each(|item| each(&mut state, item))
        }
    }

    impl<I: Iterator> ParallelIterator for I {}
}
