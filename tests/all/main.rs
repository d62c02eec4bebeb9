//! Tests of whole commands and pipelines, one program of them all: each is a module, and `cargo test --test all
//! pipeline::` runs those of one.

#[path = "../common/mod.rs"]
mod common;
#[path = "../common/matrices.rs"]
mod matrices;
#[path = "../common/merge_levels.rs"]
mod merge_levels;
#[path = "../common/photon_sensor.rs"]
mod photon_sensor;

mod bad_input;
mod cameras;
mod check;
mod examples;
mod extremes;
mod factor;
mod findings;
mod foreign_stores;
mod formats;
mod geometry;
mod hot_pixels;
mod import;
mod import_matrix;
mod labs;
mod merge;
mod noise;
mod outputs;
mod parts;
mod passes;
mod patterns;
mod pipeline;
mod properties;
mod radiometry;
mod raw;
mod relight;
mod run;
mod simulate;
mod tradeoff;
mod turned;
