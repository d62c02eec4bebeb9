//! What lies on the bench before any photograph: the scene, the slab, and the light of each of its dots.

use super::{
    SimulateOptions, Transport,
    light::dots::{Dots, Glow},
    light::validity,
    scene::SimulatedScene,
    slab::SlabRecord,
    slab::layout::{self, Built, SlabPlace},
};
use crate::{Result, SimulateWarning, geometry::Point, progress::Progress, transport::Row};
use std::sync::Mutex;

/// The scene, its slab, and what solves for the slab's light.
#[derive(Debug)]
pub(super) struct Bench {
    pub scene: SimulatedScene,
    pub dots: Dots,
    /// The slab, readable.
    pub record: SlabRecord,
    /// Findings about the slab.
    pub warnings: Vec<SimulateWarning>,
    /// Of every dot so far.
    noise: Mutex<Vec<DotNoise>>,
}

/// Row, photon noise and light of a dot.
pub(super) type DotNoise = (usize, f64, f64);

impl Bench {
    /// Sets the bench up.
    pub(super) fn new(options: &SimulateOptions, progress: &Progress) -> Result<Self> {
        let scene = SimulatedScene::new(options)?;
        let place = SlabPlace {
            lit_origin_mm: scene.lit_origin_mm,
            lit_size_mm: scene.lit_size_mm,
            size_mm: scene.slab_size_mm,
        };
        let Built { volume, record, mut warnings } = layout::build(options, &place)?;
        if options.transport == Transport::Diffusion {
            let [width, height] = options.window_mm();
            warnings.extend(validity::warnings(&volume, &record, width.min(height)));
        }
        let middle = scene.beam(options.grid.map(|n| n / 2), [0.0; 2]);
        let dots = Dots::new(options, volume, scene.eye_mm, &middle, progress)?;
        Ok(Self { scene, dots, record, warnings, noise: Mutex::default() })
    }

    /// The light of one dot per unit of its flux.
    pub(super) fn glow(&self, dot: [usize; 2], drift_mm: Point) -> Result<Glow> {
        self.dots.glow(&self.scene.beam(dot, drift_mm), self.scene.grid.row_index(dot))
    }

    /// The rectangle of the slab that its light does not leave, mm.
    pub(super) fn reach_mm(&self, dot: [usize; 2], drift_mm: Point) -> [Point; 2] {
        self.dots.reach_mm(&self.scene.beam(dot, drift_mm))
    }

    /// Its flux under full white.
    pub(super) fn flux(&self, dot: [usize; 2], drift_mm: Point) -> [f64; 3] {
        let area_mm2 = self.scene.grid.dot_area_px2()
            * self.scene.slab_from_projector.area_scale(self.scene.grid.dot_projector_px(dot));
        self.scene.white_irradiance(self.scene.dot_mm(dot, drift_mm)).map(|e| e * area_mm2)
    }

    /// The true row of a dot; its photon noise is remembered.
    pub(super) fn row(&self, options: &SimulateOptions, dot: [usize; 2], drift_mm: Point, glow: &Glow) -> Row {
        let response = glow.cell_means(self.scene.dot_mm(dot, drift_mm), options.window, options.pitch_mm);
        if let Ok(mut noise) = self.noise.lock() {
            let light = response.iter().map(|r| f64::from(*r).powi(2)).sum();
            noise.push((self.scene.grid.row_index(dot), glow.variance_sum, light));
        }
        let (variance, valid) = (vec![0.0; response.len()], vec![true; response.len()]);
        Row { response, variance, valid }
    }

    /// What is remembered of some rows.
    pub(super) fn noise_of(&self, rows: &[usize]) -> Vec<DotNoise> {
        let noise = self.noise.lock().map(|noise| noise.clone()).unwrap_or_default();
        noise.into_iter().filter(|(row, ..)| rows.contains(row)).collect()
    }

    /// Noise of dots that another run has made.
    pub(super) fn remember(&self, dots: Vec<DotNoise>) {
        if let Ok(mut noise) = self.noise.lock() {
            noise.extend(dots);
        }
    }

    /// The photon noise of the truth: the standard error of all rows over the rows, both Euclidean; `None` without
    /// noise.
    pub(super) fn photon_noise(&self) -> Option<f64> {
        let mut noise = self.noise.lock().map(|noise| noise.clone()).unwrap_or_default();
        // In the order of the rows, so that the sum does not depend on the threads.
        noise.sort_by_key(|(row, ..)| *row);
        let (error, light) = noise.iter().fold((0.0, 0.0), |(e, l), (_, error, light)| (e + error, l + light));
        (error > 0.0).then(|| (error / light).sqrt())
    }
}
