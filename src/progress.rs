//! Progress bars on stderr, silent when there is no terminal or when asked.

use indicatif::{MultiProgress, ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::Write;
use std::time::Instant;

/// Where stages report how far they are, and how long each took.
#[derive(Debug)]
pub struct Progress {
    bars: MultiProgress,
    timings: std::sync::Mutex<Vec<StageTime>>,
}

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
        Self { bars: MultiProgress::with_draw_target(target), timings: Default::default() }
    }

    /// Begins a stage of `steps` steps; its time is recorded when the returned guard is dropped.
    pub fn stage(&self, name: &str, steps: usize) -> Stage<'_> {
        let bar = self.bars.add(ProgressBar::new(steps as u64));
        let style = ProgressStyle::with_template("{msg:<12} [{bar:32}] {pos}/{len}  {elapsed} (left {eta})");
        if let Ok(style) = style {
            bar.set_style(style.progress_chars("=> "));
        }
        bar.set_message(name.to_owned());
        Stage { progress: self, bar, name: name.to_owned(), start: Instant::now() }
    }

    /// Prints a line on stderr above the bars.
    pub fn say(&self, line: impl std::fmt::Display) {
        // A closed stderr must not end the work.
        self.bars.suspend(|| {
            let _ = writeln!(std::io::stderr(), "{line}");
        });
    }

    /// The stages that have ended, in that order.
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
    /// `n` more steps are done; callable from any thread.
    pub fn advance(&self, n: usize) {
        self.bar.inc(n as u64);
    }
}

impl Drop for Stage<'_> {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
        if let Ok(mut timings) = self.progress.timings.lock() {
            timings.push(StageTime { stage: self.name.clone(), secs: self.start.elapsed().as_secs_f64() });
        }
    }
}
