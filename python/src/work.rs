//! Long work: without Python's lock, with progress, until Ctrl-C.

use crate::errors::{internal, raised};
use acquire::progress::{Progress, Stopped};
use pyo3::prelude::*;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Condvar, Mutex};
use std::time::Duration;

/// How often Python is asked for signals, and progress is told.
const POLL: Duration = Duration::from_millis(50);

/// Where progress goes: `None` nowhere, `True` to bars on stderr, else a callable that takes a stage's name, steps
/// done, and steps in all.
pub(crate) type Report<'py> = Option<Bound<'py, PyAny>>;

/// Does `work` on a thread of its own. Ctrl-C ends it at its next step, when nothing that looks whole has been written.
pub(crate) fn run<T: Send>(
    py: Python<'_>,
    report: Report<'_>,
    work: impl FnOnce(&Progress) -> acquire::Result<T> + Send,
) -> PyResult<T> {
    let bars = report.as_ref().is_some_and(|report| report.is_exact_instance_of::<pyo3::types::PyBool>());
    let progress = if bars { Progress::terminal() } else { Progress::silent() };
    let (done, changed) = (Mutex::new(false), Condvar::new());
    let mut interrupted = None;
    let result = std::thread::scope(|scope| {
        let worker = scope.spawn(|| {
            let result = catch_unwind(AssertUnwindSafe(|| work(&progress)));
            if let Ok(mut done) = done.lock() {
                *done = true;
            }
            changed.notify_all();
            result
        });
        while !worker.is_finished() {
            py.detach(|| {
                if let Ok(guard) = done.lock() {
                    drop(changed.wait_timeout_while(guard, POLL, |done| !*done));
                }
            });
            let told = py.check_signals().and_then(|()| tell(&report, bars, &progress));
            if let Err(e) = told {
                progress.stop();
                interrupted.get_or_insert(e);
            }
        }
        worker.join()
    });
    if let Some(e) = interrupted {
        return Err(e);
    }
    match result {
        Ok(Ok(result)) => result.map_err(raised),
        Ok(Err(panic)) if panic.is::<Stopped>() => Err(internal("stopped without a signal")),
        _ => Err(internal("the library panicked; the lines above say where")),
    }
}

fn tell(report: &Report<'_>, bars: bool, progress: &Progress) -> PyResult<()> {
    match (report, progress.running()) {
        (Some(report), Some((stage, done, all))) if !bars => report.call1((stage, done, all)).map(drop),
        _ => Ok(()),
    }
}
