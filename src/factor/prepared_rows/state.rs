//! How rows are prepared, for tasks that prepare some of them alike.

use super::super::content::Content;
use super::super::fill::Basis;
use super::super::noise::NoiseSums;
use super::super::survey::Survey;
use super::super::tasks::{Passes, SavedMaterial};
use super::{PreparedRows, patterns};
use crate::material::Layout;
use crate::output::numbers;
use crate::transport::normalize::Placement;
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// All that one row's preparation depends on.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(in crate::factor) struct RowsState {
    content: Content,
    /// The largest response, mm⁻².
    peak: f64,
    /// Samples of the common window.
    extended: [usize; 2],
    #[serde(with = "numbers")]
    shifts: Vec<[i16; 2]>,
    /// What rows are divided by, where they are normalized.
    #[serde(with = "numbers")]
    scales: Vec<f64>,
    #[serde(with = "numbers")]
    metric: Vec<f32>,
    basis: Basis,
    through: Option<SavedMaterial>,
}

impl<'a> PreparedRows<'a> {
    pub(super) fn state(&self) -> Box<RowsState> {
        let placements = &self.survey.placements;
        let normalized = self.content == Content::Intensity;
        Box::new(RowsState {
            content: self.content,
            peak: self.survey.peak,
            extended: self.survey.layout.extended,
            shifts: placements.iter().map(|p| p.shift).collect(),
            scales: placements.iter().filter(|_| normalized).map(|p| p.scale).collect(),
            metric: self.metric.clone(),
            basis: self.basis.clone(),
            through: self.through.as_ref().map(SavedMaterial::from),
        })
    }

    /// Some rows of a matrix, prepared so; for passes, which need nothing else of the survey.
    pub(in crate::factor) fn of_state(matrix: Passes<'a>, state: RowsState, range: Range<usize>) -> Self {
        let scale = |k: usize| state.scales.get(k).copied().unwrap_or(1.0);
        let placed = |(k, &shift): (usize, &[i16; 2])| Placement { shift, scale: scale(k), limited: false };
        let survey = Survey {
            placements: state.shifts.iter().enumerate().map(placed).collect(),
            layout: Layout { window: matrix.reader.header().window, extended: state.extended },
            peak: state.peak,
            mean: Vec::new(),
            noise: NoiseSums::default(),
            complete: false,
            entries: 0,
            energy: 0.0,
            grey: false,
            warnings: Vec::new(),
        };
        let patterns = patterns(&survey, state.content);
        Self {
            range,
            survey,
            content: state.content,
            metric: state.metric,
            noise: NoiseSums::default(),
            through: state.through.map(|maps| maps.material(matrix.reader)),
            basis: state.basis,
            cache: None,
            patterns,
            matrix,
        }
    }
}
