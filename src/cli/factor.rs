use super::Context;
use crate::Result;
use crate::factor::{Options, factor};
use crate::material::Model;
use crate::transport::MatrixReader;
use std::path::PathBuf;

/// Factor a matrix into a compact material.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  acquire factor slab.rd.zarr                                  terms and degree as the noise supports
  acquire factor slab.rd.zarr --terms 15 --degree 7            the paper's setting
  acquire factor slab.rd.zarr --no-peak-shift --out a.safetensors")]
pub struct Args {
    /// The matrix, a folder *.rd.zarr.
    matrix: PathBuf,
    /// What the material is [default: tucker when --degree is given, else joint; with a target whichever serves it better].
    #[arg(long, value_enum)]
    model: Option<Model>,
    /// Number of terms [default: as many as exceed the measured noise].
    #[arg(long, value_name = "T")]
    terms: Option<usize>,
    /// Degree of the colour polynomial, 0 to 15 [default: as the measured noise supports].
    #[arg(long, value_name = "P")]
    degree: Option<usize>,
    /// Leave every row where it is instead of moving its peak to the centre.
    #[arg(long)]
    no_peak_shift: bool,
    /// How far a peak may be from its lit point, in samples [default: a quarter of the window].
    #[arg(long, value_name = "SAMPLES", conflicts_with = "no_peak_shift")]
    max_shift: Option<usize>,
    /// The material to write [default: the matrix's name with .safetensors, in the working directory].
    #[arg(long, short, value_name = "FILE")]
    out: Option<PathBuf>,
}

pub fn run(args: Args, context: &Context) -> Result<()> {
    let out = args.out.unwrap_or_else(|| {
        let name = args.matrix.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        PathBuf::from(format!("{}.safetensors", name.trim_end_matches(".zarr").trim_end_matches(".rd")))
    });
    super::check_output(&out, &[&args.matrix])?;
    let reader = MatrixReader::open(&args.matrix)?;
    let options = Options {
        model: args.model,
        terms: args.terms,
        degree: args.degree,
        peak_shift: !args.no_peak_shift,
        max_shift: args.max_shift,
        ..Options::default()
    };
    let before = reader.header().warnings.len();
    let factored = factor(&reader, &options, &context.progress)?;
    factored.material.header.warnings.iter().skip(before).for_each(|w| context.warn(w));
    factored.material.save(&out)?;
    let matrix_bytes = 4 * (reader.header().rows() * reader.header().row_len()) as u64;
    let bytes = factored.material.bytes_f32();
    context.done(&factored.choice);
    context.done(format_args!(
        "{}: {} bytes of f32, 1/{:.0} of the matrix, rel_rmse {:.5}",
        out.display(),
        bytes,
        matrix_bytes as f64 / bytes as f64,
        factored.rel_rmse
    ));
    Ok(())
}
