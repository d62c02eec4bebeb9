use super::Context;
use super::values::{model, precision, yes_or_no};
use crate::factor::{
    Backend, FactorOptions, Goal, ROOM_DB, Storage, Stored, TaskFolder, factor_and_store, factor_and_store_by_tasks,
};
use crate::material::{Model, Precision};
use crate::output::write_whole;
use crate::transport::MatrixReader;
use crate::words::count;
use crate::{Error, Result};
use std::ops::Range;
use std::path::PathBuf;

/// Factor a matrix into a compact material.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  acquire factor slab.rd.zarr                            as many terms as the noise supports
  acquire factor slab.rd.zarr --target-psnr 45           the fewest bytes that reach it
  acquire factor slab.rd.zarr --max-bytes 250kB          the best of at most 250 kB
  acquire factor slab.rd.zarr --target-psnr 45 --out slab.acq    the same, coded: far fewer bytes
  acquire factor slab.rd.zarr --terms 15 --degree 7      the paper's model and setting
  acquire factor slab.rd.zarr --model peers2006 --terms 13
  acquire factor slab.rd.zarr --memory 2GiB --backend gram
  acquire factor slab.rd.zarr --terms 15 --tasks passes/ --parts 64    by many processes: docs/scale.md")]
pub(super) struct Args {
    /// The matrix, a folder *.rd.zarr.
    #[arg(value_parser = super::things::matrix())]
    matrix: PathBuf,
    #[command(flatten)]
    options: Options,
    /// The material to write [default: the matrix's name with .safetensors, in the working directory].
    #[arg(long, short, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Replace an earlier material there.
    #[arg(long)]
    force: bool,
    /// Let tasks (`acquire factor-part`) go over the rows: writes the pass that is due into this folder and prints its
    /// missing parts, K/N, a line each; to be called again when they are there. Prints none when the material is made.
    #[arg(long, value_name = "DIR")]
    tasks: Option<PathBuf>,
    /// With --tasks: how many share a pass [default: 32, or as many as have 512 MiB of responses each].
    #[arg(long, value_name = "N", requires = "tasks")]
    parts: Option<usize>,
}

/// All that can be asked of a factorization.
#[derive(Debug, clap::Args)]
pub(super) struct Options {
    /// What the material is [default: tucker when --degree is given, else joint; with a target whichever serves it
    /// better].
    #[arg(long, value_parser = model())]
    model: Option<Model>,
    /// Number of terms [default: as many as exceed the measured noise].
    #[arg(long, value_name = "T")]
    terms: Option<usize>,
    /// Degree of the colour polynomial, 0 to 15 [default: as the measured noise supports].
    #[arg(long, value_name = "P")]
    degree: Option<usize>,
    /// Choose the fewest bytes that reach this psnr_db against the matrix.
    #[arg(long, value_name = "DB", allow_negative_numbers = true, conflicts_with = "terms")]
    target_psnr: Option<f64>,
    /// Choose the best material of at most this size (bytes_f32, half of it for f16, the whole file when coded): 250kB,
    /// 1.5MiB, or plain bytes.
    #[arg(long, value_name = "BYTES", value_parser = bytes, conflicts_with_all = ["terms", "target_psnr"])]
    max_bytes: Option<u64>,
    /// With --model peers2006: factor the intensity, and make colour a polynomial of it as tucker does.
    #[arg(long)]
    color_regression: bool,
    /// How numbers are stored: f32 or f16 in a .safetensors, or coded in a .acq [default: f32, coded when --out ends in
    /// .acq].
    #[arg(long, value_parser = precision())]
    precision: Option<Precision>,
    /// With --precision coded: the error that coding may add, relative to the material [default: 0.003; a target
    /// decides it].
    #[arg(long, value_name = "SHARE", allow_negative_numbers = true, conflicts_with_all = ["target_psnr", "max_bytes"])]
    added_error: Option<f64>,
    /// How singular values are computed [default: the quickest for the size that reaches --accuracy].
    #[arg(long, value_enum)]
    backend: Option<Backend>,
    /// Largest error of singular values, relative to the largest of them.
    #[arg(long, value_name = "SHARE", allow_negative_numbers = true, default_value_t = FactorOptions::default().accuracy)]
    accuracy: f64,
    /// Memory for the rows, such as 2GiB; rows beyond it are read from the store at every pass [default: half of the
    /// machine's].
    #[arg(long, value_name = "BYTES", value_parser = bytes)]
    memory: Option<u64>,
    /// Entry and exit maps, so that every row has its albedo and the slab under even light its exitance: yes or no
    /// [default: for joint, where they differ from one by more than noise, unless a target is given].
    #[arg(long, value_name = "yes|no", value_parser = yes_or_no)]
    maps: Option<bool>,
    /// For joint: the power of the mean profile by which errors are divided: 0 for peaks, 0.5 for tails.
    #[arg(long, value_name = "POWER", allow_negative_numbers = true, default_value_t = FactorOptions::default().profile_power)]
    profile_power: f64,
    /// Leave every row where it is instead of moving its peak to the centre.
    #[arg(long)]
    no_peak_shift: bool,
    /// How far a peak may be from its lit point, in samples [default: a quarter of the window].
    #[arg(long, value_name = "SAMPLES", conflicts_with = "no_peak_shift")]
    max_shift: Option<usize>,
}

impl Options {
    /// As the library has them; `precision` where none is given.
    pub(super) fn options(self, precision: Precision) -> Result<(FactorOptions, Storage)> {
        let precision = self.precision.unwrap_or(precision);
        check(&self, precision)?;
        let options = FactorOptions {
            model: self.model,
            terms: self.terms,
            degree: self.degree,
            goal: match (self.target_psnr, self.max_bytes) {
                (Some(db), _) => Goal::Psnr(db),
                (None, Some(bytes)) => Goal::Bytes(bytes),
                (None, None) => Goal::Noise,
            },
            color_regression: self.color_regression,
            maps: self.maps,
            profile_power: self.profile_power,
            backend: self.backend,
            accuracy: self.accuracy,
            memory_bytes: self.memory,
            peak_shift: !self.no_peak_shift,
            max_shift: self.max_shift,
            ..FactorOptions::default()
        };
        Ok((options, Storage { precision, added_error: self.added_error }))
    }
}

/// Refuses options that contradict each other.
fn check(args: &Options, precision: Precision) -> Result<()> {
    let refuse =
        |setting, expected: &str, found: String| Err(Error::Setting { setting, expected: expected.into(), found });
    if args.added_error.is_some() && precision != Precision::Coded {
        return refuse(
            "added_error",
            "--precision coded, or an --out that ends in .acq, beside it",
            precision.to_string(),
        );
    }
    if args.color_regression && args.model != Some(Model::Peers2006) {
        return refuse("color_regression", "--model peers2006 beside it", "another model".into());
    }
    Ok(())
}

/// What storing adds and what is then off in all, in words.
fn in_all(stored: &Stored) -> String {
    let psnr = stored.psnr_db().map(|db| format!(", psnr_db {db:.2}"));
    format!(
        "which adds an error of {:.5} (about {:.5}{} in all)",
        stored.added_error,
        stored.rel_rmse(),
        psnr.unwrap_or_default()
    )
}

pub(super) fn run(args: Args, context: &Context) -> Result<()> {
    let (asked, target_psnr) = (args.options.precision, args.options.target_psnr);
    let out = args.out.clone().unwrap_or_else(|| {
        let name = args.matrix.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let end = if asked == Some(Precision::Coded) { "acq" } else { "safetensors" };
        PathBuf::from(format!("{}.{end}", name.trim_end_matches(".zarr").trim_end_matches(".rd")))
    });
    let coded = out.extension().is_some_and(|e| e == "acq");
    let (options, storage) = args.options.options(if coded { Precision::Coded } else { Precision::F32 })?;
    // What the name says is what others will take the file for.
    let endings = match asked {
        None => &super::MATERIALS[..],
        Some(Precision::Coded) => &["acq"],
        Some(_) => &["safetensors"],
    };
    super::check_output("out", &out, &[&args.matrix], endings, args.force)?;
    let reader = MatrixReader::open(&args.matrix)?;
    let stored = match args.tasks {
        None => factor_and_store(&reader, &options, &storage, &context.progress)?,
        Some(path) => {
            let folder = TaskFolder { path, parts: args.parts };
            match factor_and_store_by_tasks(&reader, &options, &storage, &folder, &context.progress) {
                Err(Error::PassDue { pass, stage, missing, of, .. }) => return due(context, pass, stage, &missing, of),
                stored => stored?,
            }
        }
    };
    write_whole(&out, stored.file.clone())?;
    let factored = &stored.factored;
    context.tell(&factored.warnings);
    let how = match storage.precision {
        Precision::F32 => String::new(),
        Precision::F16 => format!(", stored as f16 in {} bytes, {}", stored.bytes, in_all(&stored)),
        Precision::Coded => format!(", coded in {} bytes, {}", stored.bytes, in_all(&stored)),
    };
    let matrix_bytes = 4 * (reader.header().rows() * reader.header().row_len()) as u64;
    let bytes = factored.material.bytes_f32();
    match (target_psnr, storage.precision) {
        (Some(db), Precision::Coded) => context.done(format_args!(
            "{}; {ROOM_DB} dB of it are reserved for coding, which leaves {db} dB",
            factored.choice
        )),
        _ => context.done(&factored.choice),
    }
    context.done(format_args!(
        "{}: {} bytes of f32, 1/{:.0} of the matrix, rel_rmse {:.5}{}{how}",
        out.display(),
        bytes,
        matrix_bytes as f64 / bytes as f64,
        factored.rel_rmse,
        factored.psnr_db.map(|db| format!(", psnr_db {db:.2}")).unwrap_or_default()
    ));
    Ok(())
}

/// Says which parts of a pass are to be done.
fn due(context: &Context, pass: usize, stage: &str, missing: &[Range<usize>], of: usize) -> Result<()> {
    let parts: Vec<String> = missing.iter().flat_map(Clone::clone).map(|part| format!("{part}/{of}")).collect();
    context.done(format_args!("pass {pass} ({stage}): {} of {of} to be done", count(parts.len(), "part")));
    super::print(&parts.join("\n"))
}

/// A number of bytes as people write it: `250kB`, `1.5 MiB`, `4096`.
pub(super) fn bytes(text: &str) -> std::result::Result<u64, String> {
    let text = text.trim();
    let end = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
    let (number, unit) = text.split_at(end);
    let scale: f64 = match unit.trim().to_ascii_lowercase().as_str() {
        "" | "b" => 1.0,
        "kb" | "k" => 1e3,
        "mb" | "m" => 1e6,
        "gb" | "g" => 1e9,
        "kib" => 1024.0,
        "mib" => 1024.0 * 1024.0,
        "gib" => 1024.0 * 1024.0 * 1024.0,
        _ => return Err("expected a number of bytes, with kB, MB, GB, KiB, MiB or GiB behind it".into()),
    };
    match number.parse::<f64>() {
        Ok(v) if v * scale >= 1.0 && v * scale < 1e18 => Ok((v * scale) as u64),
        _ => Err("expected a positive number of bytes".into()),
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn bytes_are_read_as_people_write_them() {
        let read = |text: &str| super::bytes(text).ok();
        assert_eq!(read("250kB"), Some(250_000));
        assert_eq!(read("1.5 MiB"), Some(1_572_864));
        assert_eq!(read("4096"), Some(4096));
        assert_eq!(read("2GiB"), Some(1 << 31));
        for bad in ["", "kB", "-3", "1 parsec", "0", "1e9", "1..2MB"] {
            assert_eq!(read(bad), None, "{bad}");
        }
    }
}
