//! Fresnel's equations for light that meets a face of the slab from inside, and their moments.

/// Share that a face reflects of unpolarized light that meets it at `cosine` (> 0) to the normal; `n` ≥ 1 the refractive
/// index inside over that outside.
#[inline]
pub(super) fn reflectance(n: f64, cosine: f64) -> f64 {
    if n == 1.0 {
        return 0.0;
    }
    let beyond2 = 1.0 - n * n * (1.0 - cosine * cosine);
    if beyond2 <= 0.0 {
        return 1.0;
    }
    let beyond = beyond2.sqrt();
    let s = (n * cosine - beyond) / (n * cosine + beyond);
    let p = (cosine - n * beyond) / (cosine + n * beyond);
    0.5 * (s * s + p * p)
}
