//! Simulate: slab transport → projector → camera, to a capture folder with real image files and its truth.
