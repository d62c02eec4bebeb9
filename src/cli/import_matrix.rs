use super::Context;
use super::values::pair_of;
use crate::transport::arrays::{ArraysInput, ArraysOptions, ImportedMatrix, import_arrays, import_store, open_arrays};
use crate::words::count;
use crate::{Error, Result, Warning};
use std::path::{Path, PathBuf};

/// Make a matrix store from arrays of NumPy, xarray or another program.
///
/// The input is an .npy (the response), an .npz or a Zarr group with arrays by name: `response` in mm⁻² suffices;
/// `variance`, `valid`, `x_i_mm`, `y_i_mm`, `position_sd_mm`, `pitch_mm` and `lit_pitch_mm` are taken when they are
/// there. docs/matrix-format.md has shapes, units and defaults.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  acquire import-matrix windows.npz --out slab.rd.zarr                     pitch_mm is in the archive
  acquire import-matrix windows.npy --pitch-mm 0.5 --out slab.rd.zarr
  acquire import-matrix sparse.npy --pitch-mm 0.25 --lit-pitch-mm 1x1.5 --out slab.rd.zarr
  acquire import-matrix full.npy --pitch-mm 0.5 --points 32x24 --window 21x21 --out slab.rd.zarr
  acquire import-matrix simulated.zarr --out slab.rd.zarr --json           what was found, for a program

Shapes of response:
  [y_i, x_i, dy, dx] or [y_i, x_i, dy, dx, channel]   windows around lit points, odd sides; 1 or 3 channels, 1 is grey
  [i, o] or [i, o, channel]                           a full matrix: from lit point i to point o of the same lattice
  [y_i, x_i, y_o, x_o] with or without channel        the same, with --full
NaN is not measured.")]
pub(super) struct Args {
    /// X.npy, X.npz, or a Zarr group or array.
    #[arg(value_parser = super::things::matrix())]
    input: PathBuf,
    /// Side of a sample, mm [default: pitch_mm of the input, which is needed then].
    #[arg(long, value_name = "MM", allow_negative_numbers = true)]
    pitch_mm: Option<f64>,
    /// Distance of lit points, mm: 1 or 1x1.5 for x and y [default: that of x_i_mm and y_i_mm; else --pitch-mm].
    #[arg(long, value_name = "MM[xMM]", value_parser = pair_of::<f64>)]
    lit_pitch_mm: Option<[f64; 2]>,
    /// Points along x and y of a full matrix [default: as many along both].
    #[arg(long, value_name = "NxN", value_parser = pair_of::<usize>)]
    points: Option<[usize; 2]>,
    /// Samples along x and y of the windows that are cut out of a full matrix, odd [default: the smallest with as many
    /// to all sides that leave out a thousandth of the light at most].
    #[arg(long, value_name = "N[xN]", value_parser = pair_of::<usize>)]
    window: Option<[usize; 2]>,
    /// The last axes are outgoing points, not offsets.
    #[arg(long)]
    full: bool,
    /// Where the matrix goes.
    #[arg(long, short, value_name = "Y.rd.zarr")]
    out: PathBuf,
    /// Replace an earlier matrix there.
    #[arg(long)]
    force: bool,
    /// Print one JSON object: sizes, defaults that were taken, and findings.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: Args, context: &Context) -> Result<()> {
    super::check_matrix_output("out", &args.out, &[&args.input], args.force)?;
    let source = format!("acquire import-matrix: {}", args.input.display());
    let imported = match open_arrays(&args.input, args.full, &attributes(&args))? {
        ArraysInput::Store(reader) => {
            refuse_unused(&args)?;
            import_store(&reader, &source, &args.out, &context.progress)?
        }
        ArraysInput::Arrays(arrays) => {
            let options = ArraysOptions {
                pitch_mm: args.pitch_mm,
                lit_pitch_mm: args.lit_pitch_mm,
                points: args.points,
                window: args.window,
                full: args.full,
                source,
            };
            import_arrays(&arrays, &options, &args.out, &context.progress)?
        }
    };
    context.tell(&imported.findings);
    if args.json {
        super::print(&json(&imported, &args.out)?)?;
    }
    for default in &imported.defaults {
        context.done(format_args!("not given, taken instead: {default}"));
    }
    context.done(summary(&imported, &args.out));
    Ok(())
}

/// What takes the place of a store's attributes.
fn attributes(args: &Args) -> serde_json::Map<String, serde_json::Value> {
    let pitch = args.pitch_mm.map(|v| ("pitch_mm".to_owned(), serde_json::json!(v)));
    let lit = args.lit_pitch_mm.map(|v| ("lit_pitch_mm".to_owned(), serde_json::json!(v)));
    pitch.into_iter().chain(lit).collect()
}

/// Options that a store with windows has no use for.
fn refuse_unused(args: &Args) -> Result<()> {
    for (setting, given) in [("points", args.points), ("window", args.window)] {
        if let Some([a, b]) = given {
            let expected = "none, as the input has windows around lit points (it is for full matrices)".into();
            return Err(Error::Setting { setting, expected, found: format!("{a}x{b}") });
        }
    }
    Ok(())
}

fn json(imported: &ImportedMatrix, out: &Path) -> Result<String> {
    let findings: Result<Vec<_>> = imported.findings.iter().map(Warning::json).collect();
    let mut object = serde_json::to_value(imported).map_err(Error::internal)?;
    object["matrix"] = serde_json::json!(out);
    object["findings"] = serde_json::Value::Array(findings?);
    serde_json::to_string_pretty(&object).map_err(Error::internal)
}

fn summary(m: &ImportedMatrix, out: &Path) -> String {
    let outside =
        m.light_outside_window.map(|share| format!(", {:.4} % of the light outside the windows", 100.0 * share));
    format!(
        "{}: {}×{} points {} mm × {} mm apart, windows of {}×{} samples of {} mm, {}{}, {:.2} % measured{}",
        out.display(),
        m.points[0],
        m.points[1],
        m.lit_pitch_mm[0],
        m.lit_pitch_mm[1],
        m.window[0],
        m.window[1],
        m.pitch_mm,
        count(m.channels, "channel"),
        if m.channels == 1 { " (grey)" } else { "" },
        100.0 * m.measured_share,
        outside.unwrap_or_default()
    )
}
