//! How values of the library's types are spelled on the command line.

use crate::material::{Model, Precision};
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};

/// One of `all`, by its name.
fn named<T: Copy + Send + Sync + 'static>(
    all: &'static [T],
    name: fn(T) -> &'static str,
    help: fn(T) -> &'static str,
) -> impl TypedValueParser<Value = T> {
    let values = all.iter().map(|&v| PossibleValue::new(name(v)).help(help(v)));
    // The parser before has refused all other names.
    PossibleValuesParser::new(values).try_map(move |typed| {
        all.iter().copied().find(|&v| name(v) == typed).ok_or_else(|| format!("no value is called {typed}"))
    })
}

/// `--model`.
pub fn model() -> impl TypedValueParser<Value = Model> {
    named(&Model::ALL, Model::name, |model| match model {
        Model::Tucker => "Intensity by error modelling, colour by a polynomial of the intensity per lit point",
        Model::Peers2006 => "The mean profile divided out, the rest a non-negative factorization",
        Model::Joint => "One factorization of the three channels together",
        _ => "",
    })
}

/// `--precision`.
pub fn precision() -> impl TypedValueParser<Value = Precision> {
    named(&Precision::ALL, Precision::name, |precision| match precision {
        Precision::F32 => "As they are, 4 bytes each",
        Precision::F16 => "Rounded to 11 bits, 2 bytes each; not for colour polynomials",
        Precision::Coded => "Transformed, quantized and entropy coded",
    })
}
