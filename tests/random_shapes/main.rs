//! What holds for every matrix and every material, tried on random shapes and values: few points and small windows that
//! are not square, displaced peaks, entries and rows that were not measured, rows of zeros, numbers from 1e-30 to 1e30.
//!
//! The shapes are the same at every run. `PROPTEST_RNG_SEED=2 PROPTEST_CASES=500` tries others.

use acquire::ResponseWarning;
use acquire::evaluate::{Measures, evaluate};
use acquire::factor::{Backend, FactorOptions, Factored, Goal, factor};
use acquire::material::coded::{self, Quality};
use acquire::material::{
    Evaluator, Exitance, Material, MaterialHeader, Model, OffsetFactors, Precision, SharedBasis, Source, save,
};
use acquire::material::{Quadrature, export_npz, lit_area, relight};
use acquire::progress::Progress;
use acquire::transport::{MatrixHeader, MatrixReader, MatrixWriter, Row, ShotRecord};
use proptest::prelude::*;
use proptest::test_runner::{RngSeed, TestRunner};
use rand::{Rng, SeedableRng};
use std::io::Read;
use std::path::Path;

mod changes;
mod factoring;
mod files;
mod material;
#[path = "../common/matrices.rs"]
mod matrices;
mod matrix;
mod measures;
mod points;
mod relighting;

use changes::{Change, changes};
use material::{KINDS, bits, formula, material, source};
use matrix::{Matrix, Stored, crop, place};

/// Half the distance of neighbouring numbers, relative: what rounding changes at most.
const F32: f64 = f32::EPSILON as f64 / 2.0;
const F64: f64 = f64::EPSILON / 2.0;

/// Tries a property on random inputs; the first that breaks it is made smaller and printed.
fn holds<S: Strategy>(cases: u32, inputs: S, property: impl Fn(S::Value)) {
    // Of the environment, if it says so; a file of failures is not kept, their shapes belong into tests of their own.
    let mut config = ProptestConfig { failure_persistence: None, ..ProptestConfig::default() };
    if std::env::var_os("PROPTEST_CASES").is_none() {
        config.cases = cases;
    }
    if config.rng_seed == RngSeed::Random {
        config.rng_seed = RngSeed::Fixed(1);
    }
    let mut runner = TestRunner::new(config);
    let found = runner.run(&inputs, |input| {
        property(input);
        Ok(())
    });
    if let Err(broken) = found {
        panic!("{broken}");
    }
}

/// Points, a window, and the seed of everything else.
#[derive(Debug, Clone, Copy)]
struct Case {
    points: [usize; 2],
    window: [usize; 2],
    seed: u64,
}

fn cases() -> impl Strategy<Value = Case> {
    let odd = || (0_usize..4).prop_map(|k| 2 * k + 1);
    ([1_usize..=7, 1..=6], [odd(), odd()], any::<u64>().no_shrink()).prop_map(|(points, window, seed)| Case {
        points,
        window,
        seed,
    })
}

/// Random numbers of a seed.
struct Draw(rand_pcg::Pcg64);

impl Draw {
    fn new(seed: u64) -> Self {
        Self(rand_pcg::Pcg64::seed_from_u64(seed))
    }

    /// Uniform from 0 to 1.
    fn unit(&mut self) -> f64 {
        (self.0.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// Uniform from −1 to 1.
    fn signed(&mut self) -> f64 {
        2.0 * self.unit() - 1.0
    }

    fn below(&mut self, n: usize) -> usize {
        (self.unit() * n as f64) as usize
    }

    fn chance(&mut self, probability: f64) -> bool {
        self.unit() < probability
    }

    fn f32s(&mut self, n: usize) -> Vec<f32> {
        (0..n).map(|_| self.signed() as f32).collect()
    }

    /// Any f32 that is finite, subnormal and negative zero too.
    fn bits(&mut self) -> f32 {
        let v = f32::from_bits(self.0.next_u32());
        if v.is_finite() { v } else { -0.0 }
    }

    /// Numbers below n in another order.
    fn order(&mut self, n: usize) -> Vec<usize> {
        let mut order: Vec<usize> = (0..n).collect();
        (1..n).rev().for_each(|k| order.swap(k, self.below(k + 1)));
        order
    }
}

fn rows_of(material: &Material) -> Vec<Vec<f32>> {
    (0..material.header.rows()).map(|i| material.evaluate_row(i)).collect()
}

fn joint(terms: usize) -> FactorOptions {
    FactorOptions {
        model: Some(Model::Joint),
        terms: Some(terms),
        backend: Some(Backend::Full),
        ..FactorOptions::default()
    }
}

/// What storing `terms` orthonormal terms as f32 changes, over ‖R‖: rows are divided by the peak, then weights, both
/// factors, shared maps and their amounts, and what comes out are rounded once each, which differs for every term, and
/// as many terms may be left out as are no larger than rounding.
fn storing(terms: usize) -> f64 {
    F32 * (2.0 + 6.0 * (terms as f64).sqrt())
}
