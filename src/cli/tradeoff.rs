use super::Context;
use crate::output::{Earlier, NewFolder, key_of};
use crate::tradeoff::{self, TradePoint, Tradeoff, TradeoffOptions, tradeoff_from};
use crate::transport::MatrixReader;
use crate::words::{count, plain};
use crate::{Error, Result};
use std::path::PathBuf;

/// Measure what time, memory, bytes and accuracy cost each other on a matrix.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  acquire tradeoff slab.rd.zarr                        every model, back end, T, P and precision
  acquire tradeoff slab.rd.zarr --quick                a block of 24 × 24 lit points, a minute or two
  acquire tradeoff slab.rd.zarr --quick --json | jq '.measured[] | select(.pareto)'

Writes tradeoff.html (opens offline), tradeoff.csv and tradeoff.json into a folder; prints the front (the settings that no other
beats in both bytes and psnr_db), what the program makes when nothing is asked, and what it recommends: the smallest whose
rel_rmse and log_rmse are no more than those of the plain default and of the matrix's noise together.")]
pub(super) struct Args {
    /// The matrix, a folder *.rd.zarr.
    #[arg(value_parser = super::things::matrix())]
    matrix: PathBuf,
    /// The folder to make [default: the matrix's name with -tradeoff, in the working directory].
    #[arg(long, short, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Only a block of 24 × 24 lit points in the middle, and fewer settings.
    #[arg(long)]
    quick: bool,
    /// Memory for the rows, such as 2GiB [default: half of the machine's].
    #[arg(long, value_name = "BYTES", value_parser = super::factor::bytes)]
    memory: Option<u64>,
    /// Replace an earlier result at DIR.
    #[arg(long)]
    force: bool,
    /// Print everything as one JSON object instead of the front.
    #[arg(long)]
    json: bool,
}

const JSON: &str = "tradeoff.json";

pub(super) fn run(args: Args, context: &Context) -> Result<()> {
    let reader = MatrixReader::open(&args.matrix)?;
    let out = args.out.unwrap_or_else(|| {
        let name = args.matrix.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        PathBuf::from(format!("{}-tradeoff", name.trim_end_matches(".zarr").trim_end_matches(".rd")))
    });
    super::check_folder("out", &out, &[&args.matrix], false)?;
    let options = TradeoffOptions { quick: args.quick, memory_bytes: args.memory };
    // Without a checksum nothing tells whether it is the same matrix: a time that no other run has.
    let matrix = reader.digest().map_or_else(|| format!("{:?}", std::time::SystemTime::now()), str::to_owned);
    let key = key_of(&("tradeoff", matrix, options.quick, options.memory_bytes))?;
    let (folder, log, earlier) = NewFolder::go_on(&out, args.force, &key)?;
    let earlier = match earlier {
        Earlier::Finished(earlier) => earlier,
        Earlier::Other => {
            context.done("a stopped run had begun with another matrix, other options or as another version: all is measured anew");
            vec![]
        }
        Earlier::Nothing => vec![],
    };
    if !earlier.is_empty() {
        context
            .done(format_args!("{} measured by a stopped run and taken over", count(earlier.len(), "factorization")));
    }
    let found = tradeoff_from(earlier, |measured| log.add(measured), &reader, &options, &context.progress);
    if found.as_ref().is_err_and(Error::is_of_system) {
        folder.keep_work();
    }
    let found = found?;
    let json = serde_json::to_string_pretty(&found).map_err(Error::internal)?;
    let files =
        [(JSON, json.clone()), ("tradeoff.csv", tradeoff::csv(&found)), ("tradeoff.html", tradeoff::html(&found))];
    for (name, text) in files {
        let path = folder.path().join(name);
        std::fs::write(&path, text).map_err(Error::io("write", &path))?;
    }
    folder.finish()?;
    let text = if args.json { json } else { front(&found) };
    super::print(&text)?;
    if let Some([median, largest]) = found.regression_conditions.get(7) {
        context.done(format_args!(
            "condition of the colour fits at degree 7: {} at the median, {} at most",
            plain(*median, 2),
            plain(*largest, 2)
        ));
    }
    context.done(format_args!(
        "{} measured: {}",
        count(found.measured.len(), "material"),
        out.join("tradeoff.html").display()
    ));
    Ok(())
}

/// What a point stands out by.
fn mark(p: &TradePoint) -> &'static str {
    match (p.pareto, p.default, p.recommended) {
        (true, true, true) => "front, default, recommended",
        (true, true, false) => "front, default",
        (true, false, true) => "front, recommended",
        (true, false, false) => "front",
        (false, true, true) => "default, recommended",
        (false, true, false) => "default",
        (false, false, true) => "recommended",
        (false, false, false) => "",
    }
}

/// The front with the default and the recommended point, by bytes, and the noise.
fn front(found: &Tradeoff) -> String {
    let told = |p: &&TradePoint| p.pareto || p.default || p.recommended;
    let mut front: Vec<_> = found.measured.iter().filter(told).collect();
    front.sort_by_key(|p| p.bytes);
    let mut text = format!(
        "{:<10} {:>3} {:>3} {:>5} {:<6} {:>10} {:>9} {:>8} {:>8} {:>8}  {}",
        "model", "T", "P", "maps", "stored", "bytes", "rel_rmse", "psnr_db", "log_rmse", "secs", "mark"
    );
    let count = |v: Option<usize>| v.map_or("-".to_owned(), |v| v.to_string());
    let number = |v: Option<f64>, digits: usize| v.map_or("-".to_owned(), |v| format!("{v:.digits$}"));
    for p in front {
        text += &format!(
            "\n{:<10} {:>3} {:>3} {:>5} {:<6} {:>10} {:>9} {:>8} {:>8} {:>8.2}  {}",
            p.model.to_string(),
            p.terms,
            count(p.degree),
            count(p.shared_maps),
            p.precision.to_string(),
            p.bytes,
            number(p.rel_rmse, 5),
            number(p.psnr_db, 2),
            number(p.log_rmse, 4),
            p.secs,
            mark(p)
        );
    }
    if let Some(n) = found.noise {
        text += &format!("\n{:<41} {:>9.5} {:>8.2} {:>8.4}", "the matrix's noise", n.rel_rmse, n.psnr_db, n.log_rmse);
    }
    text
}
