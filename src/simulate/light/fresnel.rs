//! What the slab's faces do to unpolarized light.

/// Light on one side of a face, seen from the side with refractive index `eta` relative to the other.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Passage {
    /// Share that is reflected.
    pub reflectance: f64,
    /// Cosine to the normal beyond the face; 0 when all is reflected.
    pub cosine: f64,
}

/// Fresnel's equations for light that meets a face at `cosine` (> 0) to its normal, `eta` the index on its side over
/// the other's.
#[inline]
pub(crate) fn face(eta: f64, cosine: f64) -> Passage {
    if eta == 1.0 {
        return Passage { reflectance: 0.0, cosine };
    }
    let beyond2 = 1.0 - eta * eta * (1.0 - cosine * cosine);
    if beyond2 <= 0.0 {
        return Passage { reflectance: 1.0, cosine: 0.0 };
    }
    let beyond = beyond2.sqrt();
    let s = (eta * cosine - beyond) / (eta * cosine + beyond);
    let p = (cosine - eta * beyond) / (cosine + eta * beyond);
    Passage { reflectance: 0.5 * (s * s + p * p), cosine: beyond }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn faces_reflect_as_in_the_textbook() {
        // Normal incidence on glass; Brewster's angle (p vanishes); beyond the critical angle.
        assert!((face(1.5, 1.0).reflectance - 0.04).abs() < 1e-15);
        let brewster = (1.0f64 / 1.5).atan();
        let s = ((1.5f64.powi(2) - 1.0) / (1.5f64.powi(2) + 1.0)).powi(2);
        assert!((face(1.5, brewster.cos()).reflectance - 0.5 * s).abs() < 1e-14);
        assert_eq!(face(1.5, 0.7).reflectance, 1.0);
        assert_eq!(face(1.0, 0.3).reflectance, 0.0);
    }

    #[test]
    fn both_ways_through_a_face_reflect_the_same() {
        for cosine in [0.05, 0.4, 0.9, 1.0] {
            let inwards = face(1.0 / 1.4, cosine);
            let outwards = face(1.4, inwards.cosine);
            assert!((inwards.reflectance - outwards.reflectance).abs() < 1e-13);
            assert!((outwards.cosine - cosine).abs() < 1e-13);
        }
    }
}
