//! What can go wrong, typed: every error names the file and field, what was expected and what was found.

use crate::words;
use std::path::{Path, PathBuf};

/// `Result` with this crate's [`Error`].
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Everything that ends the work.
///
/// All but [`Error::Internal`] are about the input or the surroundings (the program exits with 1);
/// `Internal` is our own fault (exit 2).
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The operating system refused a file.
    #[error("{}: cannot {action}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What was tried: "read", "create", …
        action: &'static str,
        /// The system's answer.
        source: std::io::Error,
    },
    /// A place that this program was built without.
    #[error("{}: needs a program with the feature `{feature}`", path.display())]
    NeedsFeature {
        /// The place.
        path: PathBuf,
        /// The feature.
        feature: &'static str,
    },
    /// A place in an object store for what is read and written on disks only.
    #[error("{}: expected a path on this machine: of object stores only captures and matrices are read, and only matrices written", path.display())]
    NotLocal {
        /// The place.
        path: PathBuf,
    },
    /// The folder is not a capture.
    #[error("{}: no capture.toml in this folder", path.display())]
    NoManifest {
        /// The folder that was named.
        path: PathBuf,
    },
    /// No rig file was found for a capture.
    #[error("{}: no rig.toml found (looked in {looked})", path.display())]
    NoRig {
        /// The capture folder.
        path: PathBuf,
        /// The places that were tried.
        looked: String,
    },
    /// A field of a text or binary file has a value that cannot be used.
    #[error("{}: {field}: expected {expected}, found {found}", path.display())]
    Field {
        /// The file.
        path: PathBuf,
        /// The field, as written in the file.
        field: String,
        /// What it should have been.
        expected: String,
        /// What it was.
        found: String,
    },
    /// A photograph named by the manifest is not there.
    #[error("{}: photograph of shot \"{shot}\" is missing", path.display())]
    MissingPhotograph {
        /// The file that was expected.
        path: PathBuf,
        /// The shot that names it.
        shot: String,
    },
    /// A photograph cannot be decoded.
    #[error("{}: photograph of shot \"{shot}\" cannot be decoded: {reason}", path.display())]
    BrokenPhotograph {
        /// The file.
        path: PathBuf,
        /// The shot that names it.
        shot: String,
        /// The decoder's message.
        reason: String,
    },
    /// A photograph is not of the size that the rig says.
    #[error(
        "{}: size: expected {} × {} px (camera.size_px in rig.toml), found {} × {} px",
        path.display(), expected[0], expected[1], found[0], found[1]
    )]
    PhotographSize {
        /// The file.
        path: PathBuf,
        /// Columns and rows that the rig says.
        expected: [usize; 2],
        /// Those that the file has.
        found: [usize; 2],
    },
    /// Neither EXIF nor the manifest gives an exposure time.
    #[error("{}: exposure_secs: expected an exposure time in EXIF (ExposureTime or ShutterSpeedValue) or in capture.toml, found neither", path.display())]
    NoExposure {
        /// The photograph.
        path: PathBuf,
    },
    /// Two photographs of one shot have the same exposure.
    #[error("{}: shot \"{shot}\": expected exposures that differ, found {first} and {second} both at {exposure_secs} s", path.display())]
    SameExposure {
        /// The manifest.
        path: PathBuf,
        /// The shot.
        shot: String,
        /// One photograph.
        first: String,
        /// The other.
        second: String,
        /// Their common exposure time.
        exposure_secs: f64,
    },
    /// A pattern lights a dot that is not on the slab.
    #[error("{}: shot \"{shot}\": dot {dot:?}: expected {expected}, found {found}", path.display())]
    DotOutsideSlab {
        /// The manifest.
        path: PathBuf,
        /// The shot.
        shot: String,
        /// The dot's grid index (x, y).
        dot: [usize; 2],
        /// The permitted range.
        expected: String,
        /// Where the dot is.
        found: String,
    },
    /// No exposure measured the peak of a dot.
    #[error("{}: shot \"{shot}\": dot {dot:?} is saturated in every exposure (shortest {shortest_secs} s)", path.display())]
    DotSaturated {
        /// The shortest photograph of the shot.
        path: PathBuf,
        /// The shot.
        shot: String,
        /// The dot's grid index (x, y).
        dot: [usize; 2],
        /// The shortest exposure time of the shot.
        shortest_secs: f64,
    },
    /// The slab, camera and projector could not be related.
    #[error("{}: shot \"{shot}\": registration failed: {reason}", path.display())]
    Registration {
        /// The photograph or manifest.
        path: PathBuf,
        /// The shot.
        shot: String,
        /// Why.
        reason: String,
    },
    /// A photograph that is not the one that the plan of a capture has next.
    #[error("{}: shot \"{shot}\": expected {expected}, found {found}", path.display())]
    DoesNotFit {
        /// The photograph.
        path: PathBuf,
        /// The shot that it would belong to.
        shot: String,
        /// What the plan has there.
        expected: String,
        /// What it is.
        found: String,
    },
    /// What a capture says twice, and so differently that no result can be believed.
    #[error("{finding}")]
    Contradiction {
        /// What was found; its name is what `accept` of [`crate::pipeline::BuildOptions`] takes.
        finding: Box<crate::Warning>,
    },
    /// What stops the work, and the likeliest cause that the files show.
    #[error("{cause}; that is why the work stops: {error}")]
    Explained {
        /// The cause.
        cause: Box<crate::Warning>,
        /// What it leads to.
        error: Box<Error>,
    },
    /// What `acquire check` found would stop `acquire build-matrix`.
    #[error("would not build: {reason}")]
    WouldNotBuild {
        /// What it would stop with.
        reason: Box<Error>,
    },
    /// A matrix store cannot be read.
    #[error("{}: incomplete or damaged matrix store: {reason}", path.display())]
    BrokenMatrix {
        /// The store.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// A Zarr group that is whole, but not a matrix as `docs/matrix-format.md` describes it.
    #[error("{}: {part}: expected {expected}, found {found}", path.display())]
    MatrixFormat {
        /// The store.
        path: PathBuf,
        /// The array or the attribute.
        part: String,
        /// What it should have been.
        expected: String,
        /// What it was.
        found: String,
    },
    /// An array that a matrix should be made from holds what makes none.
    #[error("{}: {array}: expected {expected}, found {found}", path.display())]
    Arrays {
        /// The file, or the output that the arrays are for.
        path: PathBuf,
        /// The array, or "archive", "file".
        array: String,
        /// What it should have been.
        expected: String,
        /// What it was.
        found: String,
    },
    /// A material file cannot be read.
    #[error("{}: incomplete or damaged material: {reason}", path.display())]
    BrokenMaterial {
        /// The file.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// An image other than a photograph (a light, say) cannot be read.
    #[error("{}: cannot be decoded: {reason}", path.display())]
    BrokenImage {
        /// The file.
        path: PathBuf,
        /// The decoder's message.
        reason: String,
    },
    /// Two inputs do not belong together.
    #[error("{} and {}: {field} differs: {a_value} and {b_value}", a.display(), b.display())]
    Mismatch {
        /// One input.
        a: PathBuf,
        /// The other.
        b: PathBuf,
        /// The quantity that differs.
        field: String,
        /// Its value in `a`.
        a_value: String,
        /// Its value in `b`.
        b_value: String,
    },
    /// Lattice shots that no part has, and nobody was told to measure.
    #[error("{}: expected all {of} lattice shots, found none of the shots {}{}", path.display(), words::spelled(missing, "shot"), words::not_used(unused))]
    MissingShots {
        /// Where parts were looked for.
        path: PathBuf,
        /// Their numbers in the sweep.
        missing: Vec<std::ops::Range<usize>>,
        /// Lattice shots in all.
        of: usize,
        /// Parts that were of no use, and why.
        unused: Vec<String>,
    },
    /// Tasks have a pass over a matrix's rows to do before its factorization goes on.
    #[error("{}: pass {pass} over the rows ({stage}) is due: expected {of} parts, found none of the parts {}", path.display(), words::spelled(missing, "part"))]
    PassDue {
        /// Where tasks find it and leave what they find.
        path: PathBuf,
        /// Which pass of the factorization, from 1.
        pass: usize,
        /// What it finds: survey, terms, measure or colour.
        stage: &'static str,
        /// The parts that are to be done, by their numbers from 1; the end of a range is not in it.
        missing: Vec<std::ops::Range<usize>>,
        /// Parts in all.
        of: usize,
    },
    /// An option has a value that cannot be used.
    #[error("{setting}: expected {expected}, found {found}")]
    Setting {
        /// The field of the options; several are separated by commas.
        setting: &'static str,
        /// What it should have been.
        expected: String,
        /// What it was.
        found: String,
    },
    /// An output folder has files in it, and replacing was not asked for.
    #[error("{}: expected an empty or a new folder, found files in it", path.display())]
    NotEmpty {
        /// The folder.
        path: PathBuf,
    },
    /// There is a file already, and replacing was not asked for.
    #[error("{}: expected a new name, found a file", path.display())]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// What would be replaced is an output of this program that somebody has changed.
    #[error("{}: not replaced, as it was changed after this program had written it", path.display())]
    Changed {
        /// The file.
        path: PathBuf,
    },
    /// What would be replaced was not made by this program.
    #[error("{}: not replaced, as it is not an output of this program", path.display())]
    NotOurs {
        /// The file, or the folder that has no record of such an output.
        path: PathBuf,
    },
    /// A value that must be finite is not.
    #[error("{}: {field}: expected finite numbers, found {found} at {at}", path.display())]
    NotFinite {
        /// The file.
        path: PathBuf,
        /// The array.
        field: &'static str,
        /// The value.
        found: f64,
        /// Its index, readable.
        at: String,
    },
    /// A voxel file holds what makes no slab.
    #[error("{}: {array}: expected {expected}, found {found}", path.display())]
    Voxels {
        /// The file or group.
        path: PathBuf,
        /// The array, or "archive", "group", "file".
        array: String,
        /// What it should have been.
        expected: String,
        /// What it was.
        found: String,
    },
    /// Diffusion has no usable answer for a slab.
    #[error(
        "diffusion does not converge in channel {channel}: after {iterations} iterations the residual is {residual:.1e} and {missing:.1e} of the light is missing"
    )]
    Diffusion {
        /// The channel: R, G or B.
        channel: char,
        /// Iterations of the solver.
        iterations: usize,
        /// Last residual over the first.
        residual: f64,
        /// Share of the light that is in none of the balance's terms.
        missing: f64,
    },
    /// Our own fault.
    #[error("internal error: {what}")]
    Internal {
        /// What was found to be impossible.
        what: String,
    },
}

impl Error {
    /// An [`Error::Io`] for `path`; made for `map_err(Error::io("read", path))`.
    pub fn io(action: &'static str, path: impl AsRef<Path>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.as_ref().to_path_buf();
        move |source| Self::Io { path, action, source }
    }

    /// An [`Error::Internal`] from anything printable.
    pub fn internal(what: impl std::fmt::Display) -> Self {
        Self::Internal { what: what.to_string() }
    }

    /// An [`Error::Field`].
    pub fn field(
        path: impl AsRef<Path>,
        field: impl Into<String>,
        expected: impl Into<String>,
        found: impl std::fmt::Display,
    ) -> Self {
        Self::Field {
            path: path.as_ref().to_path_buf(),
            field: field.into(),
            expected: expected.into(),
            found: found.to_string(),
        }
    }

    /// [`Error::Field`] unless `value` lies in `low` to `high`.
    pub(crate) fn unless_within(
        path: impl AsRef<Path>,
        field: impl Into<String>,
        value: f64,
        low: f64,
        high: f64,
    ) -> Result<()> {
        match value >= low && value <= high {
            true => Ok(()),
            false => Err(Self::field(path, field, format!("{} to {}", number(low), number(high)), number(value))),
        }
    }

    /// Whether this is our own fault rather than the input's.
    pub fn is_internal(&self) -> bool {
        matches!(self, Self::Internal { .. })
    }

    /// Whether the system ended the work, which is to be done again as it was: a full disk, a file that cannot be read.
    pub(crate) fn is_of_system(&self) -> bool {
        match self {
            Self::Io { .. } => true,
            Self::Explained { error, .. } => error.is_of_system(),
            _ => false,
        }
    }
}

/// A number as a person would write it: huge and tiny ones with an exponent.
pub(crate) fn number(v: f64) -> String {
    if v == 0.0 || (1e-4..1e15).contains(&v.abs()) || !v.is_finite() { v.to_string() } else { format!("{v:e}") }
}
