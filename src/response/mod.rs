//! Extract: for each lit point the window of responses, with variance.

mod crosstalk;
mod extract;
mod irradiance;
mod reconstruct;

pub use crosstalk::{LeftByOthers, LitRow, Separation, TailModel, fit_tails, reach_mm};
pub use extract::{LitDot, RowFindings, WindowGrid, extract_row, window_rect};
pub use irradiance::{Flux, Irradiance, Sensitivity};
pub use reconstruct::CellWeights;
