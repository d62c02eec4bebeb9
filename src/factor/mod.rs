//! Factor: the matrix, streamed, to a compact material.
