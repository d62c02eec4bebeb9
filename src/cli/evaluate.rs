use super::Context;
use crate::evaluate::{Measures, evaluate};
use crate::material::Source;
use crate::transport::MatrixReader;
use crate::{Error, Result};
use std::path::PathBuf;

/// Compare a material or a matrix with a reference matrix.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  acquire evaluate slab.safetensors slab.rd.zarr            what the factorization lost
  acquire evaluate slab.rd.zarr truth.rd.zarr --json        what the measurement missed, for a program

docs/metrics.md defines every measure.")]
pub(super) struct Args {
    /// A material (*.safetensors) or a matrix (*.rd.zarr).
    #[arg(value_parser = super::things::matrix())]
    candidate: PathBuf,
    /// The matrix to compare with.
    #[arg(value_parser = super::things::matrix())]
    reference: PathBuf,
    /// Print one JSON object instead of a table.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: Args, context: &Context) -> Result<()> {
    let candidate = Source::open(&args.candidate)?;
    let reference = MatrixReader::open(&args.reference)?;
    let measures = evaluate(&candidate, &reference, &context.progress)?;
    let text =
        if args.json { serde_json::to_string_pretty(&measures).map_err(Error::internal)? } else { table(&measures) };
    super::print(&text)?;
    context.done(format_args!("{} entries compared", measures.entries));
    Ok(())
}

fn table(m: &Measures) -> String {
    let number = |v: Option<f64>, unit: &str| match v {
        Some(v) => format!("{v:.5}{unit}"),
        None => "-".to_owned(),
    };
    let rgb = |v: [f64; 3]| format!("{:.4} {:.4} {:.4}", v[0], v[1], v[2]);
    let with_sd = |[bias, sd]: [f64; 2]| format!("{bias:+.5} ± {sd:.5}");
    let bias = m
        .albedo_bias
        .zip(m.albedo_bias_sd)
        .map_or("-".to_owned(), |(bias, sd)| [0, 1, 2].map(|c| with_sd([bias[c], sd[c]])).join(" "));
    let lines = [
        ("rel_rmse", number(m.rel_rmse, "")),
        ("psnr_db", number(m.psnr_db, " dB")),
        ("log_rmse", number(m.log_rmse, "")),
        ("relit_psnr_db", number(m.relit_psnr_db, " dB")),
        ("bytes_f32", m.bytes_f32.to_string()),
        ("bytes_file", m.bytes_file.to_string()),
        ("albedo_max", rgb(m.albedo_max)),
        ("albedo_mean", rgb(m.albedo_mean)),
        ("albedo_violations", format!("{} rows", m.albedo_violations)),
        ("reciprocity", number(m.reciprocity, "")),
        ("coverage_2sigma", number(m.coverage_2sigma, "")),
        ("coverage_2sigma_rows", number(m.coverage_2sigma_rows, "")),
        ("coverage_2sigma_profile", number(m.coverage_2sigma_profile, "")),
        ("albedo_bias", bias),
        ("drift_rms_px", number(m.drift_rms_px, " px")),
        ("position_rms_mm", number(Some(m.position_rms_mm), " mm")),
        ("position_rms_px", number(m.position_rms_px, " px")),
    ];
    lines.map(|(name, value)| format!("{name:<23} {value}")).join("\n")
}
