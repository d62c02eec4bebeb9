//! Factor: the matrix, streamed, to a compact material.
//!
//! All models go the same way: a survey places the rows, what is factored of them (intensity, grey, three channels) is
//! decomposed into terms (singular triplets or a non-negative product), and where the model has one a colour polynomial
//! is fitted to every row.

mod agreement;
mod backend;
mod choose;
mod color;
mod content;
mod entry_exit;
mod fill;
mod independent;
mod moments;
mod noise;
mod nonnegative;
mod prepared_rows;
mod products;
mod regression;
mod shared_basis;
mod storing;
mod survey;
mod tasks;
mod term_rows;
mod terms;
#[cfg(test)]
mod test_matrices;
mod vector;

pub use agreement::Agreement;
pub use backend::Backend;
pub use choose::{Goal, regression_conditions};
pub use storing::{ROOM_DB, Storage, Stored, factor_and_store};
pub use tasks::{PassReport, TaskFolder, factor_and_store_by_tasks, factor_part};

use crate::material::legendre::MOST_DEGREE;
use crate::material::{Material, Model};
use crate::progress::Progress;
use crate::transport::MatrixReader;
use crate::words::count;
use crate::{Error, FactorWarning, Result};
use content::Content;
use entry_exit::Marginals;
use prepared_rows::PreparedRows;
use tasks::Passes;

/// How to factor.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct FactorOptions {
    /// The model; `None`: `tucker` when a degree is asked for, else `joint`, or with a goal whichever of the two serves
    /// it better.
    pub model: Option<Model>,
    /// For `peers2006`: the intensity is factored and the colour of each row a polynomial of it, as in `tucker`.
    pub color_regression: bool,
    /// T; `None`: as the goal says. Never more than the matrix has.
    pub terms: Option<usize>,
    /// P, 0 to 15; `None`: as the goal says.
    pub degree: Option<usize>,
    /// What decides on T, P and the model where they are not given.
    pub goal: Goal,
    /// Whether entry and exit maps multiply the terms, so that every row has its albedo and the slab under even light
    /// its exitance (not with a colour polynomial). `None`: for `joint`, where they differ from one by more than noise,
    /// unless a `psnr_db` or bytes are the goal: of entries, `psnr_db` is better without in the same bytes.
    pub maps: Option<bool>,
    /// For `joint`: the power of the mean profile by which errors are divided before their squares are summed, 0 to 1.
    /// 0.25: tails' logarithms are off by a third to a half less than with 0, and `rel_rmse` is a tenth larger; 0.5 is
    /// the weight of photon noise.
    pub profile_power: f64,
    /// Whether rows are moved so that their peaks coincide; the paper does.
    pub peak_shift: bool,
    /// How far a peak may be from its lit point, in samples; `None`: a quarter of the window. Beyond it the brightest
    /// sample is rather another dot or noise than where this dot's light leaves.
    pub max_shift: Option<usize>,
    /// The most terms that the noise may choose; 40, well above the paper's 15. A goal may choose up to four times as
    /// many.
    pub max_terms: usize,
    /// The highest degree that is chosen when not given; 15, twice the paper's 7.
    pub max_degree: usize,
    /// How often samples that a row did not measure are estimated anew from the factors; 2, after which the
    /// spectrum above the noise no longer changes visibly. Not used when nothing is missing.
    pub fill_rounds: usize,
    /// How the truncated SVD is computed; `None`: by size and `accuracy`.
    pub backend: Option<Backend>,
    /// What singular values may be off by, relative to the largest; 1e-5, a tenth of what the most careful capture can
    /// tell.
    pub accuracy: f64,
    /// Bytes that the rows may take in memory; beyond it they are read from the store at every pass. `None`: half of
    /// the machine's.
    pub memory_bytes: Option<u64>,
}

impl Default for FactorOptions {
    fn default() -> Self {
        Self {
            model: None,
            color_regression: false,
            terms: None,
            degree: None,
            goal: Goal::Noise,
            maps: None,
            profile_power: 0.25,
            peak_shift: true,
            max_shift: None,
            max_terms: 40,
            max_degree: MOST_DEGREE,
            fill_rounds: 2,
            backend: None,
            accuracy: 1e-5,
            memory_bytes: None,
        }
    }
}

/// A material and what the factorization says about itself.
#[derive(Debug, Clone)]
pub struct Factored {
    /// The material; its header has the warnings of the matrix, then those below.
    pub material: Material,
    /// Findings of the factorization.
    pub warnings: Vec<FactorWarning>,
    /// ‖R̂−R‖ / ‖R‖ over the valid entries of the matrix it was made from.
    pub rel_rmse: f64,
    /// `psnr_db` of `docs/metrics.md` on the same entries; `None` when nothing is left or nothing was there.
    pub psnr_db: Option<f64>,
    /// Where it stands to the matrix's noise; `None` for a matrix without variance.
    pub agreement: Option<Agreement>,
    /// Why it has the terms and the degree that it has, and how they were computed, one line.
    pub choice: String,
    /// How the SVD was computed.
    pub backend: Backend,
    /// The singular values among which terms were chosen, of the rows before entry and exit maps are divided out,
    /// largest first; none for `peers2006`.
    pub levels: Vec<TermLevel>,
}

/// A singular value beside what noise alone would give in the same directions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TermLevel {
    /// The singular value, in the unit of the header's.
    pub singular_value: f64,
    /// Its noise, likewise.
    pub noise: f64,
    /// Whether the term was kept.
    pub kept: bool,
}

/// Squared errors of a fit and what they are measured by.
#[derive(Debug, Clone, Copy)]
struct Misfit {
    /// Σ (R̂−R)².
    error: f64,
    /// Σ R².
    energy: f64,
    peak: f64,
    entries: u64,
}

impl Misfit {
    fn rel_rmse(&self) -> f64 {
        if self.energy > 0.0 { (self.error / self.energy).sqrt() } else { 0.0 }
    }

    fn psnr_db(&self) -> Option<f64> {
        let rmse = (self.error / self.entries.max(1) as f64).sqrt();
        (self.peak > 0.0 && rmse > 0.0).then(|| 20.0 * (self.peak / rmse).log10())
    }
}

/// Factors a matrix.
///
/// Reads the store twice where its rows (as they are factored) fit into `memory_bytes`; otherwise once for the survey
/// and once for each pass of the back end, so that memory is bounded by a block of rows, the factors, and what the back
/// end keeps of columns (their square with [`Backend::Gram`], all rows with [`Backend::Full`]).
///
/// # Errors
/// [`Error::Setting`] for options out of range; those of the reader; [`Error::NotFinite`] when a response is so
/// large that a coefficient does not fit an f32.
pub fn factor(reader: &MatrixReader, options: &FactorOptions, progress: &Progress) -> Result<Factored> {
    factored(Passes::here(reader, progress), options)
}

fn factored(matrix: Passes<'_>, options: &FactorOptions) -> Result<Factored> {
    options.check()?;
    // Its own threads divide sums among themselves: the last digits would depend on their number. What takes long is in
    // `products`.
    faer::set_global_parallelism(faer::Par::Seq);
    let one = |model| factor_as(matrix, model, options);
    match (options.model, options.degree, options.goal) {
        (Some(model), ..) => one(model),
        (None, Some(_), _) => one(Model::Tucker),
        (None, None, Goal::Noise) => one(Model::Joint),
        (None, None, goal) => {
            let (joint, tucker) = (one(Model::Joint)?, one(Model::Tucker)?);
            Ok(if goal.prefers(&tucker, &joint) { tucker } else { joint })
        }
    }
}

fn factor_as(matrix: Passes<'_>, model: Model, options: &FactorOptions) -> Result<Factored> {
    let reader = matrix.reader;
    let window = reader.header().window;
    let limit: [usize; 2] = match options.peak_shift {
        true => std::array::from_fn(|a| options.max_shift.unwrap_or(window[a] / 4).min(window[a] / 2).min(30_000)),
        false => [0, 0],
    };
    let memory = options.memory_bytes.unwrap_or_else(half_of_memory);
    let regression = model == Model::Tucker || (model == Model::Peers2006 && options.color_regression);
    let colored = if regression { Content::Intensity } else { Content::Channels };
    let wanted = match options.maps {
        Some(maps) => maps,
        None => model == Model::Joint && (options.terms.is_some() || options.goal == Goal::Noise),
    };
    let power = if model == Model::Joint { options.profile_power } else { 0.0 };
    let prepared = |content| -> Result<(PreparedRows<'_>, Option<Marginals>)> {
        let mut sums = match wanted && content != Content::Intensity {
            // Where no image of the slab can be made, maps that are not asked for are not made either.
            true => {
                Marginals::new(reader).map(Some).or_else(|e| if options.maps.is_some() { Err(e) } else { Ok(None) })?
            }
            false => None,
        };
        let rows = PreparedRows::new(matrix, content, limit, memory, power, sums.as_mut())?;
        Ok((rows, sums))
    };
    let grey = options.degree.is_none() && choose::looks_grey(reader)?;
    let (mut rows, mut sums) = prepared(if grey { Content::Grey } else { colored })?;
    if grey && !rows.survey.grey {
        (rows, sums) = prepared(colored)?;
    }
    let mut fit = terms::fit(reader, &mut rows, model, options, sums.as_ref())?;
    let mut why_degree = String::new();
    if rows.content == Content::Intensity {
        let degree = match (options.degree, fit.degree) {
            (Some(p), _) => (p, "as asked".to_owned()),
            (None, Some(p)) => (p, "as the goal asks".to_owned()),
            (None, None) => choose::degree_by_noise(reader, &fit.material, options.max_degree)?,
        };
        why_degree = format!("; degree {}: {}", degree.0, degree.1);
        fit.misfit = rows.survey.misfit(regression::color(matrix, &mut fit.material, degree.0)?);
    }
    let terms = fit.material.header.terms;
    let grey =
        if rows.content == Content::Grey { ", no colour: the channels differ by no more than noise" } else { "" };
    let maps = fit
        .material
        .header
        .shared_maps
        .map(|k| format!("; channels share {}", count(k, "offset map")))
        .unwrap_or_default();
    let choice = format!("{model}, terms {terms}: {}{maps}{why_degree}{grey}; {}", fit.why, fit.how);
    let (rel_rmse, psnr_db) = (fit.misfit.rel_rmse(), fit.misfit.psnr_db());
    let mut material = fit.material;
    check_finite(reader, &material)?;
    let agreement = agreement::agreement(reader, &material)?;
    let choice = format!("{choice}{}", agreement.map(|a| format!("; {a}")).unwrap_or_default());
    let mut warnings = rows.survey.warnings.clone();
    if options.terms.is_none() {
        warnings.extend(options.goal.missed(&material, psnr_db));
    }
    let of_matrix = reader.header().warnings.iter().map(serde_json::to_value);
    let all = of_matrix.chain(warnings.iter().map(serde_json::to_value));
    material.header.warnings = all.collect::<Result<_, _>>().map_err(Error::internal)?;
    material.header.provenance = serde_json::json!({
        "version": env!("CARGO_PKG_VERSION"),
        "options": options,
        "backend": fit.backend,
        "choice": choice,
        "rel_rmse": rel_rmse,
        "agreement": agreement,
        "matrix": reader.header().provenance,
    });
    let (backend, levels) = (fit.backend, fit.levels);
    Ok(Factored { material, warnings, rel_rmse, psnr_db, agreement, choice, backend, levels })
}

/// Half of the machine's memory; 4 GiB where the system does not tell.
fn half_of_memory() -> u64 {
    let text = std::fs::read_to_string("/proc/meminfo").unwrap_or_default();
    let total =
        text.lines().find_map(|l| l.strip_prefix("MemTotal:")?.trim().strip_suffix("kB")?.trim().parse::<u64>().ok());
    total.map_or(4 << 30, |kib| kib * 512)
}

/// Refuses a material that holds what no file may.
fn check_finite(reader: &MatrixReader, material: &Material) -> Result<()> {
    for (field, _, values) in material.tensors() {
        if let Some(at) = values.iter().position(|v| !v.is_finite()) {
            let (found, at) = (f64::from(values[at]), format!("number {at}"));
            return Err(Error::NotFinite { path: reader.path().to_path_buf(), field, found, at });
        }
    }
    Ok(())
}

impl FactorOptions {
    /// Refuses values that make no material.
    ///
    /// # Errors
    /// [`Error::Setting`] naming the option as typed.
    pub fn check(&self) -> Result<()> {
        let refuse =
            |setting, expected: &str, found: String| Err(Error::Setting { setting, expected: expected.into(), found });
        let degree = "0 to 15";
        match self {
            Self { terms: Some(0), .. } => refuse("terms", "at least 1", "0".into()),
            Self { max_terms: 0, .. } => refuse("max_terms", "at least 1", "0".into()),
            Self { degree: Some(p), .. } if *p > MOST_DEGREE => refuse("degree", degree, p.to_string()),
            Self { max_degree: p, .. } if *p > MOST_DEGREE => refuse("max_degree", degree, p.to_string()),
            Self { degree: Some(p), model: Some(Model::Joint), .. } => {
                refuse("degree", "none, the model joint has no colour polynomial", p.to_string())
            }
            Self { degree: Some(p), model: Some(Model::Peers2006), color_regression: false, .. } => {
                refuse("degree", "none without color_regression", p.to_string())
            }
            Self { accuracy: a, .. } if !(*a > 0.0 && *a < 1.0) => {
                refuse("accuracy", "above 0 and below 1", a.to_string())
            }
            Self { profile_power: p, .. } if !(0.0..=1.0).contains(p) => {
                refuse("profile_power", "0 to 1", p.to_string())
            }
            Self { goal: Goal::Psnr(db), .. } if !(*db > 0.0 && *db <= 150.0) => {
                refuse("target_psnr", "above 0 and up to 150 dB", db.to_string())
            }
            Self { goal: Goal::Bytes(0), .. } => refuse("max_bytes", "at least 1", "0".into()),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_that_make_no_material_are_refused_by_name_and_limits_are_not() {
        let base = FactorOptions::default;
        let joint = Some(Model::Joint);
        let peers = Some(Model::Peers2006);
        let refused = [
            ("terms", FactorOptions { terms: Some(0), ..base() }),
            ("max_terms", FactorOptions { max_terms: 0, ..base() }),
            ("degree", FactorOptions { degree: Some(16), ..base() }),
            ("max_degree", FactorOptions { max_degree: 16, ..base() }),
            ("degree", FactorOptions { degree: Some(2), model: joint, ..base() }),
            ("degree", FactorOptions { degree: Some(2), model: peers, ..base() }),
            ("accuracy", FactorOptions { accuracy: 0.0, ..base() }),
            ("accuracy", FactorOptions { accuracy: 1.0, ..base() }),
            ("accuracy", FactorOptions { accuracy: f64::NAN, ..base() }),
            ("profile_power", FactorOptions { profile_power: -0.1, ..base() }),
            ("profile_power", FactorOptions { profile_power: f64::NAN, ..base() }),
            ("target_psnr", FactorOptions { goal: Goal::Psnr(0.0), ..base() }),
            ("target_psnr", FactorOptions { goal: Goal::Psnr(150.5), ..base() }),
            ("target_psnr", FactorOptions { goal: Goal::Psnr(f64::NAN), ..base() }),
            ("max_bytes", FactorOptions { goal: Goal::Bytes(0), ..base() }),
        ];
        for (name, options) in refused {
            let found = options.check();
            assert!(matches!(found, Err(Error::Setting { setting, .. }) if setting == name), "{name}: {found:?}");
        }
        let taken = [
            base(),
            FactorOptions { terms: Some(1), max_terms: 1, degree: Some(15), max_degree: 15, ..base() },
            FactorOptions { degree: Some(2), model: peers, color_regression: true, ..base() },
            FactorOptions { goal: Goal::Psnr(150.0), accuracy: 0.5, ..base() },
            FactorOptions { goal: Goal::Bytes(1), ..base() },
        ];
        assert!(taken.iter().all(|o| o.check().is_ok()));
    }

    #[test]
    fn a_misfit_is_measured_by_the_energy_and_by_the_peak() {
        let misfit = Misfit { error: 8.0, energy: 200.0, peak: 4.0, entries: 50 };
        assert!((misfit.rel_rmse() - 0.2).abs() < 1e-15, "rounding");
        // RMSE 0.4, a tenth of the peak.
        assert!((misfit.psnr_db().unwrap() - 20.0).abs() < 1e-12, "rounding");
        let nothing = Misfit { error: 0.0, energy: 0.0, peak: 0.0, entries: 0 };
        assert_eq!((nothing.rel_rmse(), nothing.psnr_db()), (0.0, None));
        assert_eq!(Misfit { peak: 0.0, ..misfit }.psnr_db(), None);
        assert_eq!(Misfit { error: 0.0, ..misfit }.psnr_db(), None);
    }

    #[test]
    fn a_material_with_a_number_that_is_not_finite_is_refused_with_its_place() {
        let row = |_| crate::transport::Row { response: vec![1.0; 9], variance: vec![0.0; 9], valid: vec![true; 9] };
        let matrix = test_matrices::stored([2, 1], [3, 1], |_| 0.0, row);
        let options =
            FactorOptions { model: Some(Model::Tucker), terms: Some(1), degree: Some(1), ..FactorOptions::default() };
        let mut material = factor(&matrix.reader, &options, &Progress::silent()).unwrap().material;
        assert!(check_finite(&matrix.reader, &material).is_ok());
        material.color_coefficients[7] = f32::INFINITY;
        let found = check_finite(&matrix.reader, &material);
        let Err(Error::NotFinite { field, at, .. }) = found else { panic!("{found:?}") };
        assert_eq!((field, at.as_str()), ("color_coefficients", "number 7"));
    }

    #[test]
    fn half_of_the_memory_is_a_sensible_number_of_bytes() {
        // From 64 MiB to 64 TiB on any machine that builds this.
        assert!((1_u64 << 26..1 << 46).contains(&half_of_memory()), "{}", half_of_memory());
    }
}
