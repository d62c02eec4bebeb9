//! Factored materials.

use crate::commands::{findings, text};
use crate::errors::{raised, refused};
use acquire::material::{
    Evaluator, ImagePlacement, Light, LightImage, LitArea, Material, Precision, Quadrature, Responses, coded,
    place_light,
};
use numpy::{
    PyArray1, PyArrayDyn, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArray3, PyUntypedArrayMethods,
};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};
use rand::{RngExt, SeedableRng};
use rayon::prelude::*;
use std::path::PathBuf;

/// Pairs of points that a thread takes at a time: some hundred microseconds of work.
const PAIRS: usize = 4096;
/// A material in memory, and what a renderer asks it.
#[pyclass(frozen, module = "acquire._acquire")]
pub(crate) struct NativeMaterial {
    pub(crate) material: Material,
    evaluator: Evaluator,
    precision: Option<Precision>,
}

impl NativeMaterial {
    /// `precision` is what it should be saved as when nothing else is asked.
    pub(crate) fn new(material: Material, precision: Option<Precision>) -> PyResult<Self> {
        let evaluator = Evaluator::new(&material).map_err(raised)?;
        Ok(Self { material, evaluator, precision })
    }

    /// Its file.
    pub(crate) fn file_bytes(&self) -> acquire::Result<Vec<u8>> {
        bytes(&self.material, self.precision.unwrap_or(Precision::F32))
    }

    fn precision(&self, name: Option<&str>) -> PyResult<Precision> {
        let Some(name) = name else { return Ok(self.precision.unwrap_or(Precision::F32)) };
        let known = Precision::ALL.into_iter().find(|p| p.name() == name);
        known.ok_or_else(|| {
            let names = Precision::ALL.map(Precision::name).join(", ");
            refused(format_args!("precision: expected one of {names}, found {name}"))
        })
    }

    /// Ends of the lit area along x and y, mm: half a lit pitch around the lattice.
    fn extent(&self) -> [[f64; 2]; 2] {
        let (h, n) = (&self.material.header, self.material.lit_mm.len().max(1) as f64);
        [0, 1].map(|a| {
            let middle = self.material.lit_mm.iter().map(|p| p[a]).sum::<f64>() / n;
            let half = h.points[a] as f64 * h.lit_pitch_mm[a] / 2.0;
            [middle - half, middle + half]
        })
    }
}

fn bytes(material: &Material, precision: Precision) -> acquire::Result<Vec<u8>> {
    Ok(match precision {
        Precision::F32 => material.to_bytes()?,
        Precision::F16 => material.to_half_bytes()?,
        Precision::Coded => coded::encode(material, &coded::EncodeOptions::default())?.bytes,
    })
}

/// An array of these numbers.
fn shaped<'py, T: numpy::Element>(
    py: Python<'py>,
    values: Vec<T>,
    shape: &[usize],
) -> PyResult<Bound<'py, PyArrayDyn<T>>> {
    PyArray1::from_vec(py, values).reshape(shape.to_vec())
}

#[pymethods]
impl NativeMaterial {
    #[staticmethod]
    fn load(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        let material = py.detach(|| acquire::material::load(&path)).map_err(raised)?;
        Self::new(material, (path.extension().is_some_and(|e| e == "acq")).then_some(Precision::Coded))
    }

    #[staticmethod]
    fn from_bytes(py: Python<'_>, data: &[u8]) -> PyResult<Self> {
        let material = py.detach(|| Material::from_bytes(data));
        Self::new(material.map_err(|e| refused(format_args!("bytes: {e}")))?, None)
    }

    fn header(&self) -> PyResult<String> {
        text(&self.material.header)
    }

    fn describe(&self) -> String {
        self.material.header.describe()
    }

    fn bytes_f32(&self) -> u64 {
        self.material.bytes_f32()
    }

    /// R̂_d of n pairs of points, (n, 2) each, mm, as (n, 3).
    fn response<'py>(
        &self,
        py: Python<'py>,
        x_i: PyReadonlyArray2<'py, f64>,
        x_o: PyReadonlyArray2<'py, f64>,
        interpolate: bool,
    ) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
        let n = x_i.shape()[0];
        let (Ok(from), Ok(to)) = (x_i.as_slice(), x_o.as_slice()) else {
            return Err(refused("x_i and x_o: expected arrays in C order, found others"));
        };
        if x_i.shape()[1] != 2 || x_o.shape() != x_i.shape() {
            let (a, b) = (x_i.shape(), x_o.shape());
            return Err(refused(format_args!("x_i and x_o: expected shape (n, 2) both, found {a:?} and {b:?}")));
        }
        let mut out = vec![0.0_f32; 3 * n];
        py.detach(|| {
            let (from, to) = (from.as_chunks::<2>().0, to.as_chunks::<2>().0);
            let pairs = from.par_chunks(PAIRS).zip(to.par_chunks(PAIRS));
            out.par_chunks_mut(3 * PAIRS).zip(pairs).for_each(|(out, (from, to))| {
                for ((out, from), to) in out.as_chunks_mut::<3>().0.iter_mut().zip(from).zip(to) {
                    *out = match interpolate {
                        true => self.evaluator.between(*from, *to),
                        false => self.evaluator.nearest(*from, *to),
                    };
                }
            });
        });
        shaped(py, out, &[n, 3])
    }

    /// Rows, (n, dy, dx, 3).
    fn rows<'py>(&self, py: Python<'py>, indices: PyReadonlyArray1<'py, i64>) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
        let h = &self.material.header;
        let rows = h.rows();
        let wanted: Option<Vec<usize>> = indices
            .as_array()
            .iter()
            .map(|&i| usize::try_from(if i < 0 { i + rows as i64 } else { i }).ok().filter(|&i| i < rows))
            .collect();
        let Some(wanted) = wanted else {
            return Err(refused(format_args!("rows: expected lit points from 0 to below {rows}")));
        };
        let mut out = vec![0.0_f32; wanted.len() * h.row_len()];
        py.detach(|| Responses::new(&self.material).interleaved(&wanted, &mut out));
        shaped(py, out, &[wanted.len(), h.window[1], h.window[0], 3])
    }

    /// The lit point that is nearest to a place, mm.
    fn nearest_point(&self, x: f64, y: f64) -> usize {
        let away = |p: &[f64; 2]| (p[0] - x).hypot(p[1] - y);
        let points = self.material.lit_mm.iter().enumerate();
        points.min_by(|a, b| away(a.1).total_cmp(&away(b.1))).map_or(0, |(i, _)| i)
    }

    /// n offsets of row `index`, mm, (n, 2), and their densities, mm⁻², (n,).
    #[allow(clippy::type_complexity, reason = "two arrays")]
    fn sample<'py>(
        &self,
        py: Python<'py>,
        index: usize,
        n: usize,
        seed: u64,
    ) -> PyResult<(Bound<'py, PyArrayDyn<f64>>, Bound<'py, PyArrayDyn<f64>>)> {
        let pitch = self.material.header.pitch_mm;
        let mut generator = rand_pcg::Pcg64::seed_from_u64(seed);
        let (mut offsets, mut densities) = (Vec::with_capacity(2 * n), Vec::with_capacity(n));
        for _ in 0..n {
            let [u, v, w]: [f64; 3] = generator.random();
            let Some(drawn) = self.evaluator.sample(index, u) else {
                return Err(refused(format_args!("x_i: lit point {index} has no response to draw from")));
            };
            // Uniform in the sample's cell.
            offsets.push((drawn.offset[0] as f64 + v - 0.5) * pitch);
            offsets.push((drawn.offset[1] as f64 + w - 0.5) * pitch);
            densities.push(drawn.probability / (pitch * pitch));
        }
        Ok((shaped(py, offsets, &[n, 2])?, shaped(py, densities, &[n])?))
    }

    /// Density with which `sample` draws offsets, mm⁻².
    fn density<'py>(
        &self,
        py: Python<'py>,
        index: usize,
        offsets: PyReadonlyArray2<'py, f64>,
    ) -> PyResult<Bound<'py, PyArrayDyn<f64>>> {
        let pitch = self.material.header.pitch_mm;
        let Ok(values) = offsets.as_slice() else { return Err(refused("offsets: expected an array in C order")) };
        let density = |d: &[f64; 2]| {
            let sample = d.map(|v| (v / pitch).round() as isize);
            self.evaluator.probability(index, sample) / (pitch * pitch)
        };
        let densities: Vec<f64> = values.as_chunks::<2>().0.iter().map(density).collect();
        let n = densities.len();
        shaped(py, densities, &[n])
    }

    /// Ends of the lit area: x from, x to, y from, y to, mm.
    fn lit_extent_mm(&self) -> [f64; 4] {
        let [x, y] = self.extent();
        [x[0], x[1], y[0], y[1]]
    }

    /// Exitance under copies of an irradiance over an extent (x from, x to, y from, y to, mm; none: the lit area),
    /// (y, x, 3), with the centre of its first sample, mm, and the findings.
    #[allow(clippy::type_complexity, reason = "an array, a place and text")]
    fn relight<'py>(
        &self,
        py: Python<'py>,
        irradiance: PyReadonlyArray3<'py, f32>,
        extent_mm: Option<[f64; 4]>,
        tile: [usize; 2],
    ) -> PyResult<(Bound<'py, PyArrayDyn<f64>>, [f64; 2], String)> {
        let &[height, width, 3] = irradiance.shape() else {
            return Err(refused("irradiance: expected shape (y, x, 3)"));
        };
        let Ok(values) = irradiance.as_slice() else { return Err(refused("irradiance: expected an array in C order")) };
        let rgb = values.as_chunks::<3>().0.to_vec();
        if rgb.is_empty() || rgb.as_flattened().iter().any(|v| !v.is_finite()) {
            return Err(refused("irradiance: expected finite numbers, one pixel or more"));
        }
        let given = Light::Image(LightImage::new([width, height], rgb));
        let extent_mm = extent_mm.map(|[x0, x1, y0, y1]| [[x0, x1], [y0, y1]]);
        let (values, size, origin, told) = py
            .detach(|| -> acquire::Result<_> {
                let shape = self.material.shape();
                let area = LitArea::of(&shape).map_err(acquire::Error::from)?;
                let (light, told) = place_light(given, &area, &ImagePlacement { extent_mm, tile })?;
                let quadrature = Quadrature::new(&area, &shape);
                let flux = light.flux(&quadrature)?;
                let images = acquire_material::relight(&self.material, &quadrature, &[flux], &|_| ())?;
                let e = images.into_iter().next().ok_or_else(|| acquire::Error::internal("no image was made"))?;
                let [r, g, b] = &e.planes;
                let values: Vec<f64> = r.iter().zip(g).zip(b).flat_map(|((r, g), b)| [*r, *g, *b]).collect();
                Ok((values, e.canvas.size, e.canvas.origin_mm, findings(told)?))
            })
            .map_err(raised)?;
        Ok((shaped(py, values, &[size[1], size[0], 3])?, origin, text(&told)?))
    }

    /// Tensors as they are stored, `shift` and `lit_mm` among them.
    fn factors<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let (m, all) = (&self.material, PyDict::new(py));
        for (name, shape, values) in m.tensors() {
            all.set_item(name, shaped(py, values.to_vec(), &shape)?)?;
        }
        let h = &m.header;
        if h.shared_maps.is_some() {
            let shape = [h.offset_planes, h.terms, h.extended[1], h.extended[0]];
            all.set_item("offset_factors", shaped(py, m.offset_factors.all().into_owned(), &shape)?)?;
        }
        all.set_item("shift", shaped(py, m.shift.as_flattened().to_vec(), &[h.rows(), 2])?)?;
        all.set_item("lit_mm", shaped(py, m.lit_mm.as_flattened().to_vec(), &[h.rows(), 2])?)?;
        Ok(all)
    }

    fn save(&self, py: Python<'_>, path: PathBuf, precision: Option<&str>, force: bool) -> PyResult<()> {
        let precision = self.precision(precision)?;
        let ending = if precision == Precision::Coded { "acq" } else { "safetensors" };
        acquire::cli::check_output("path", &path, &[], &[ending], force).map_err(raised)?;
        py.detach(|| acquire::material::save(&self.material, precision, &path)).map_err(raised)
    }

    fn to_bytes<'py>(&self, py: Python<'py>, precision: Option<&str>) -> PyResult<Bound<'py, PyBytes>> {
        let precision = self.precision(precision)?;
        let bytes = py.detach(|| bytes(&self.material, precision)).map_err(raised)?;
        Ok(PyBytes::new(py, &bytes))
    }

    fn export(&self, py: Python<'_>, path: PathBuf, force: bool) -> PyResult<()> {
        acquire::cli::check_output("path", &path, &[], &["npz", "exr"], force).map_err(raised)?;
        let npz = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("npz"));
        let exported = py.detach(|| match npz {
            true => acquire::material::export_npz(&self.material, &path),
            false => acquire::material::export_exr(&self.material, &path),
        });
        exported.map_err(raised)
    }
}
