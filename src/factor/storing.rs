//! From a matrix to the bytes of a material's file: factors and their storage together keep to a goal.

use super::tasks::Passes;
use super::{FactorOptions, Factored, Goal, factored};
use crate::material::coded::{self, Quality, encode};
use crate::material::{Material, Precision, Responses};
use crate::progress::Progress;
use crate::transport::MatrixReader;
use crate::{Error, Result};

/// How much better than a target the factors are before they are coded, dB: a fifth of the squared error is then
/// theirs, the rest the coder's, which is about the best split (docs/materials.md).
pub const ROOM_DB: f64 = 7.0;
/// Bytes of f32 for each byte of a coded budget: what is tried, from more to fewer terms.
const CODED_RATIOS: [u64; 3] = [60, 15, 4];
/// The error that coding adds when nothing else is asked.
const ADDED_ERROR: f64 = 3e-3;
/// Rows looked at to tell what rounding costs.
const ROUNDED_ROWS: usize = 512;

/// How the numbers of a material are stored.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Storage {
    /// Their precision.
    pub precision: Precision,
    /// What coding may add, relative to the material; `None`: .003, or what the goal leaves.
    pub added_error: Option<f64>,
}

/// A material and its file.
#[derive(Debug, Clone)]
pub struct Stored {
    /// What was stored; errors are those before storing.
    pub factored: Factored,
    /// The file.
    pub file: Vec<u8>,
    /// Stored numbers: all of them in f32 or f16; the whole file when coded.
    pub bytes: u64,
    /// What storing changed, ‖R̂_stored − R̂‖ / ‖R̂‖; 0 for f32.
    pub added_error: f64,
}

impl Stored {
    /// ‖R̂_stored − R‖ / ‖R‖, as far as the two errors are independent.
    pub fn rel_rmse(&self) -> f64 {
        self.factored.rel_rmse.hypot(self.added_error)
    }

    /// `psnr_db` of what is stored, likewise.
    pub fn psnr_db(&self) -> Option<f64> {
        let before = self.factored.psnr_db.filter(|_| self.factored.rel_rmse > 0.0)?;
        Some(before - 20.0 * (self.rel_rmse() / self.factored.rel_rmse).log10())
    }
}

/// Factors a matrix and stores the material; [`FactorOptions::goal`] is that of the stored material.
///
/// # Errors
/// Those of [`super::factor`]; [`Error::Setting`] for a goal or an added error that storing cannot keep to.
pub fn factor_and_store(
    reader: &MatrixReader,
    options: &FactorOptions,
    storage: &Storage,
    progress: &Progress,
) -> Result<Stored> {
    store(Passes::here(reader, progress), options, storage)
}

pub(super) fn store(matrix: Passes<'_>, options: &FactorOptions, storage: &Storage) -> Result<Stored> {
    match storage.precision {
        Precision::F32 => {
            let factored = factored(matrix, options)?;
            let (file, bytes) = (factored.material.to_bytes()?, factored.material.bytes_f32());
            Ok(Stored { factored, file, bytes, added_error: 0.0 })
        }
        Precision::F16 => {
            let goal = match options.goal {
                Goal::Bytes(bytes) => Goal::Bytes(bytes.saturating_mul(2)),
                goal => goal,
            };
            let factored = factored(matrix, &FactorOptions { goal, ..options.clone() })?;
            let (file, bytes) = (factored.material.to_half_bytes()?, factored.material.bytes_f32() / 2);
            let added_error = changed(&factored.material, &Material::from_bytes(&file)?);
            Ok(Stored { factored, file, bytes, added_error })
        }
        Precision::Coded => coded(matrix, options, storage),
    }
}

fn coded(matrix: Passes<'_>, options: &FactorOptions, storage: &Storage) -> Result<Stored> {
    let goals = match options.goal {
        // Coding needs room of its own.
        Goal::Psnr(db) => vec![Goal::Psnr(db + ROOM_DB)],
        // The coder decides what each of more terms than it can keep is worth; even the maps that are nothing take some
        // bits.
        Goal::Bytes(bytes) if options.terms.is_none() => {
            CODED_RATIOS.iter().map(|&ratio| Goal::Bytes(bytes.saturating_mul(ratio))).collect()
        }
        goal => vec![goal],
    };
    let mut last = Err(Error::internal("no goal was tried"));
    for goal in goals {
        let factored = factored(matrix, &FactorOptions { goal, ..options.clone() })?;
        let quality = match options.goal {
            Goal::Bytes(bytes) => Quality::MaxBytes(bytes),
            goal => Quality::AddedError(storage.added_error.unwrap_or_else(|| room(&factored, goal))),
        };
        match encode(&factored.material, &coded::EncodeOptions { quality, ..coded::EncodeOptions::default() }) {
            Ok(coded) => {
                let (bytes, added_error) = (coded.bytes.len() as u64, coded.added_error);
                return Ok(Stored { factored, file: coded.bytes, bytes, added_error });
            }
            Err(error) => last = Err(of_goal(error.into(), options.goal)),
        }
        if !matches!(last, Err(Error::Setting { .. })) {
            break;
        }
    }
    last
}

/// The error that coding may add, relative to the material, so that the goal is met.
fn room(factored: &Factored, goal: Goal) -> f64 {
    let (Goal::Psnr(target), Some(reached)) = (goal, factored.psnr_db) else { return ADDED_ERROR };
    let allowed = factored.rel_rmse * 10.0_f64.powf((reached - target) / 20.0);
    // A little less: what is added is not quite orthogonal to what was left.
    0.98 * (allowed * allowed - factored.rel_rmse * factored.rel_rmse).max(0.0).sqrt()
}

/// An error of the coder, named after the goal that it comes from.
fn of_goal(error: Error, goal: Goal) -> Error {
    match (error, goal) {
        (Error::Setting { expected, found, .. }, Goal::Bytes(_)) => {
            Error::Setting { setting: "max_bytes", expected, found }
        }
        (Error::Setting { found, .. }, Goal::Psnr(_)) => Error::Setting {
            setting: "target_psnr",
            expected: "a target that coding can keep to (a plain file reaches more)".into(),
            found: format!("one that lets coding add {found}"),
        },
        (other, _) => other,
    }
}

/// ‖R̂_stored − R̂‖ / ‖R̂‖ over rows spread evenly.
fn changed(exact: &Material, stored: &Material) -> f64 {
    let rows = exact.header.rows();
    let (exact, stored) = (Responses::new(exact), Responses::new(stored));
    let (mut error, mut energy) = (0.0, 0.0);
    for i in (0..rows).step_by(rows.div_ceil(ROUNDED_ROWS).max(1)) {
        for (&a, &b) in exact.row(i).iter().zip(&stored.row(i)) {
            error += (f64::from(a) - f64::from(b)).powi(2);
            energy += f64::from(a).powi(2);
        }
    }
    if energy > 0.0 { (error / energy).sqrt() } else { 0.0 }
}
