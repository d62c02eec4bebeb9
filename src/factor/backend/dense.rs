//! Decompositions of the whole matrix, or of its Gram matrix, in f64.

use super::{LowRank, Rows, eigen, transposed, widened};
use crate::factor::products::add_gram;
use crate::{Error, Result};
use faer::{Mat, MatRef};

pub(super) fn full(rows: &dyn Rows, k: usize) -> Result<LowRank> {
    let (n, m) = rows.shape();
    let mut all = Vec::with_capacity(n * m);
    rows.for_each(&mut |_, block| {
        all.extend(block.iter().map(|&v| f64::from(v)));
        Ok(())
    })?;
    let a = MatRef::from_row_major_slice(&all, n, m);
    let svd = a.thin_svd().map_err(|e| Error::internal(format!("the SVD did not converge: {e:?}")))?;
    Ok(LowRank::new(svd.S().column_vector().iter().take(k).copied().collect(), transposed(svd.V(), k)))
}

pub(super) fn gram(rows: &dyn Rows, k: usize) -> Result<LowRank> {
    let (values, vectors) = eigen(rows.gram()?.as_ref(), k)?;
    Ok(LowRank::new(values, transposed(vectors.as_ref(), k)))
}

pub(in crate::factor) fn gram_here<R: Rows + ?Sized>(rows: &R) -> Result<Mat<f64>> {
    let m = rows.shape().1;
    let mut gram = Mat::<f64>::zeros(m, m);
    rows.for_each(&mut |_, block| {
        let wide = widened(block);
        let block = MatRef::from_row_major_slice(&wide, wide.len() / m, m);
        add_gram(gram.as_mut(), block);
        Ok(())
    })?;
    Ok(gram)
}
