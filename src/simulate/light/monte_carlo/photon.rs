//! What walks.

/// Where a photon is, where it goes, and what it is worth.
pub(super) struct Photon {
    pub p: [f64; 3],
    pub d: [f64; 3],
    pub layer: usize,
    pub weight: f64,
    /// Whether it has been since it entered.
    pub scattered: bool,
}
