//! Progress bars on stderr, silent when there is no terminal or when asked.

use indicatif::{MultiProgress, ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::Write;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Where stages report how far they are, and how long each took.
#[derive(Debug)]
pub struct Progress {
    bars: MultiProgress,
    timings: Mutex<Vec<StageTime>>,
    running: Mutex<Vec<(String, ProgressBar)>>,
    stopped: AtomicBool,
}

/// What a stage unwinds with after [`Progress::stop`].
#[derive(Debug, Clone, Copy)]
pub struct Stopped;

/// The wall time of one stage.
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
pub struct StageTime {
    /// The stage, as its bar names it.
    pub stage: String,
    /// Seconds from its first step to its last.
    pub secs: f64,
}

impl Progress {
    /// Bars on stderr when it is a terminal.
    pub fn terminal() -> Self {
        Self::with(ProgressDrawTarget::stderr())
    }

    /// No bars at all.
    pub fn silent() -> Self {
        Self::with(ProgressDrawTarget::hidden())
    }

    fn with(target: ProgressDrawTarget) -> Self {
        Self {
            bars: MultiProgress::with_draw_target(target),
            timings: Mutex::default(),
            running: Mutex::default(),
            stopped: AtomicBool::new(false),
        }
    }

    /// Ends the work from another thread: the next step of a stage unwinds with [`Stopped`] through all that is at
    /// work, which removes unfinished outputs. Whoever calls this catches it with `catch_unwind`.
    pub fn stop(&self) {
        self.stopped.store(true, Ordering::Relaxed);
    }

    /// The stage that was begun last and is not done: its name, steps done, and steps in all.
    pub fn running(&self) -> Option<(String, u64, u64)> {
        let running = self.running.lock().ok()?;
        let (name, bar) = running.last()?;
        Some((name.clone(), bar.position(), bar.length().unwrap_or(0)))
    }

    fn unwind_if_stopped(&self) {
        if self.stopped.load(Ordering::Relaxed) {
            // No panic of ours: nothing is printed.
            std::panic::resume_unwind(Box::new(Stopped));
        }
    }

    /// Begins a stage of `steps` steps; its time is recorded when the returned guard is dropped.
    pub fn stage(&self, name: &str, steps: usize) -> Stage<'_> {
        self.unwind_if_stopped();
        let bar = self.bars.add(ProgressBar::new(steps as u64));
        let style = ProgressStyle::with_template("{msg:<12} [{bar:32}] {pos}/{len}  {elapsed} (left {eta})");
        if let Ok(style) = style {
            bar.set_style(style.progress_chars("=> "));
        }
        bar.set_message(name.to_owned());
        if let Ok(mut running) = self.running.lock() {
            running.push((name.to_owned(), bar.clone()));
        }
        Stage { progress: self, bar, name: name.to_owned(), start: Instant::now() }
    }

    /// Prints a line on stderr above the bars.
    pub fn say(&self, line: impl std::fmt::Display) {
        // A closed stderr must not end the work.
        self.bars.suspend(|| {
            let _ = writeln!(std::io::stderr(), "{line}");
        });
    }

    /// The stages that have ended, in that order; those of one name, as the passes of a factorization, are one.
    pub fn timings(&self) -> Vec<StageTime> {
        self.timings.lock().map(|t| t.clone()).unwrap_or_default()
    }
}

/// A running stage; dropping it ends the bar and records the time.
#[derive(Debug)]
pub struct Stage<'a> {
    progress: &'a Progress,
    bar: ProgressBar,
    name: String,
    start: Instant,
}

impl Stage<'_> {
    /// A step may begin. After [`Progress::stop`] none does: steps that wait for a core would otherwise be made in
    /// vain.
    pub fn begin(&self) {
        self.progress.unwind_if_stopped();
    }

    /// `n` more steps are done; callable from any thread.
    pub fn advance(&self, n: usize) {
        self.bar.inc(n as u64);
        self.progress.unwind_if_stopped();
    }
}

impl Drop for Stage<'_> {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
        if let Ok(mut running) = self.progress.running.lock()
            && let Some(at) = running.iter().rposition(|(name, _)| *name == self.name)
        {
            running.remove(at);
        }
        if let Ok(mut timings) = self.progress.timings.lock() {
            let secs = self.start.elapsed().as_secs_f64();
            match timings.iter_mut().find(|t| t.stage == self.name) {
                Some(earlier) => earlier.secs += secs,
                None => timings.push(StageTime { stage: self.name.clone(), secs }),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stages_of_one_name_are_one_in_the_timings() {
        let progress = Progress::silent();
        for name in ["survey", "factor", "factor", "color", "factor"] {
            drop(progress.stage(name, 1));
        }
        let names: Vec<String> = progress.timings().into_iter().map(|t| t.stage).collect();
        assert_eq!(names, ["survey", "factor", "color"]);
    }

    #[test]
    fn a_stop_unwinds_the_stage_at_its_next_step_and_not_before() {
        let progress = Progress::silent();
        let stage = progress.stage("rows", 3);
        stage.advance(2);
        assert_eq!(progress.running(), Some(("rows".into(), 2, 3)));
        stage.begin();
        progress.stop();
        let begun = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| stage.begin()));
        assert!(begun.unwrap_err().is::<Stopped>());
        let step = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| stage.advance(1)));
        assert!(step.unwrap_err().is::<Stopped>());
        drop(stage);
        assert_eq!(progress.running(), None);
        let next = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| drop(progress.stage("next", 1))));
        assert!(next.unwrap_err().is::<Stopped>());
    }
}
