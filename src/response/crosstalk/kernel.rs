//! A function of distance on even nodes.

/// A positive function of distance, linear between its nodes and constant beyond the last.
#[derive(Debug, Clone)]
pub(super) struct Kernel {
    step_mm: f64,
    pub(super) value: Vec<f64>,
}

/// Where between two nodes a distance lies.
#[derive(Debug, Clone, Copy)]
pub(super) struct Place {
    pub(super) node: u32,
    pub(super) share: f32,
}

impl Kernel {
    /// Nodes from 0 in steps of `step_mm`; at least two values.
    pub(super) fn new(step_mm: f64, value: Vec<f64>) -> Self {
        Self { step_mm, value }
    }

    /// Where `distance_mm` lies; beyond the last node, at it.
    pub(super) fn place(step_mm: f64, nodes: usize, distance_mm: f64) -> Place {
        let t = (distance_mm / step_mm).min((nodes - 1) as f64);
        let node = (t as usize).min(nodes - 2);
        Place { node: node as u32, share: (t - node as f64) as f32 }
    }

    pub(super) fn at(&self, place: Place) -> f64 {
        interpolate(&self.value, place)
    }

    pub(super) fn at_distance(&self, distance_mm: f64) -> f64 {
        self.at(Self::place(self.step_mm, self.value.len(), distance_mm))
    }

    pub(super) fn place_of(&self, distance_mm: f64) -> Place {
        Self::place(self.step_mm, self.value.len(), distance_mm)
    }
}

pub(super) fn interpolate(values: &[f64], place: Place) -> f64 {
    let (k, t) = (place.node as usize, f64::from(place.share));
    values[k] + t * (values[k + 1] - values[k])
}
