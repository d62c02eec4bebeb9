//! Register: slab ↔ camera ↔ projector, and the drift of every lattice shot.
