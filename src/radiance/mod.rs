//! Merge: the exposures of one shot to linear radiance, its variance and a validity mask.
