//! Options of stages from words as they are typed, for front ends that are no terminal: Python has one list of options
//! with this program.

use super::{build_matrix, factor, one_line, simulate};
use crate::factor::{FactorOptions, Storage};
use crate::pipeline::BuildOptions;
use crate::simulate::SimulateOptions;
use crate::{Error, Result};
use clap::Parser;

/// The arguments of one subcommand, without a program's name.
#[derive(Debug, Parser)]
#[command(no_binary_name = true, disable_help_flag = true)]
struct Words<T: clap::Args> {
    #[command(flatten)]
    args: T,
}

fn parse<T: clap::Args>(command: &str, words: &[String]) -> Result<T> {
    let parsed = Words::<T>::try_parse_from(words);
    parsed.map(|words| words.args).map_err(|e| {
        // Without usage and the pointer to --help.
        let text = e.render().to_string();
        let text = text.split("\n\nUsage:").next().unwrap_or_default().trim_start_matches("error: ").to_owned();
        let expected = format!("those of `acquire {command}`");
        Error::Setting { setting: "options", expected, found: one_line(&text) }
    })
}

/// Options of [`crate::simulate::simulate`]; `words` are those of `acquire simulate` behind the folder.
///
/// # Errors
/// [`Error::Setting`].
pub fn simulate_options(words: &[String]) -> Result<SimulateOptions> {
    parse::<simulate::Options>("simulate", words)?.options()
}

/// Options of [`crate::pipeline::build_matrix`]; `words` are those of `acquire build-matrix` behind the folder.
///
/// # Errors
/// [`Error::Setting`].
pub fn build_options(words: &[String]) -> Result<BuildOptions> {
    Ok(parse::<build_matrix::Options>("build-matrix", words)?.into())
}

/// Options of [`crate::factor::factor_and_store`]; `words` are those of `acquire factor` behind the matrix, but for
/// `--out`.
///
/// # Errors
/// [`Error::Setting`].
pub fn factor_options(words: &[String]) -> Result<(FactorOptions, Storage)> {
    parse::<factor::Options>("factor", words)?.options(crate::material::Precision::F32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::factor::Goal;

    fn words(text: &str) -> Vec<String> {
        text.split_whitespace().map(str::to_owned).collect()
    }

    #[test]
    fn words_are_the_options_of_the_commands() {
        let simulated = simulate_options(&words("--grid 8x6 --seed 3 --only drift")).unwrap();
        assert_eq!((simulated.grid, simulated.seed), ([8, 6], 3));
        assert_eq!(simulate_options(&[]).unwrap(), SimulateOptions::default());
        let (options, storage) = factor_options(&words("--target-psnr 45 --precision f16 --no-peak-shift")).unwrap();
        assert_eq!((options.goal, options.peak_shift), (Goal::Psnr(45.0), false));
        assert_eq!(storage.precision, crate::material::Precision::F16);
        assert_eq!(factor_options(&[]).unwrap().0, FactorOptions::default());
        assert!(build_options(&words("--keep-crosstalk")).unwrap().keep_crosstalk);
    }

    #[test]
    fn words_that_are_no_options_are_refused_in_one_line() {
        let said = simulate_options(&words("--gird 8")).unwrap_err().to_string();
        assert!(said.contains("'--gird'") && said.contains("--grid") && !said.contains('\n'), "{said}");
        let said = factor_options(&words("--terms 3 --max-bytes 2kB")).unwrap_err().to_string();
        assert!(said.contains("--max-bytes") && !said.contains("Usage"), "{said}");
        assert!(factor_options(&words("--color-regression")).is_err());
    }
}
