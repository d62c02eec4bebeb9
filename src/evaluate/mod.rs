//! Evaluate: the measures of `docs/metrics.md`.
