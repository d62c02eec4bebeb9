//! The bench: projector, camera, frame and board around the slab, and how far each lattice shot has drifted.

pub(crate) mod drift;
pub(crate) mod patterns;
pub(crate) mod pixels;

pub(crate) use drift::JUMP_REACH;

use crate::simulate::{Beam, SimulateOptions};
use crate::{
    Error, Result,
    capture::{Board, Camera, FrameMarks, Grid, Projector, Rig, WhiteReference},
    geometry::{CameraView, Homography, Lens, Point, SlabFromProjector},
};
use std::f64::consts::PI;

/// Width of the opaque frame, in outgoing pitches.
const FRAME_PITCHES: f64 = 7.0;
/// Albedo of the frame: its dots are about as bright as those on the sample, so that one bracket suits both.
pub(crate) const FRAME_ALBEDO: f64 = 0.06;
/// How much darker the frame's marks are.
const MARK_DARKNESS: f64 = 0.8;
/// Softness of printed edges, the board's and the marks', camera px.
const PRINT_BLUR_PX: f64 = 0.2;
/// What is seen around the frame, camera px.
const IMAGE_MARGIN_PX: f64 = 10.0;
/// Keystone of the projector: change of scale over the lit area.
const KEYSTONE: [f64; 2] = [0.015, -0.010];
/// How far beside the camera's axis the slab's centre is seen, of the sample's extent in the picture.
const CAMERA_AIM: [f64; 2] = [0.04, -0.03];
/// Softness (standard deviation, camera px) of the sharpest projected edge that six points a pixel average without
/// displacing it by more than some thousandths of a pixel.
const FINEST_EDGE_PX: f64 = 0.12;
/// The second term of the lens's distortion, of the first.
const LENS_K2: f64 = -0.2;
/// The projector's colour.
const PROJECTOR_COLOR: [f64; 3] = [1.0, 0.95, 0.85];
/// Reflectance of the white reference: a little yellow, as such references are after some years.
const WHITE_REFLECTANCE: [f64; 3] = [0.97, 0.94, 0.88];
/// Where the reference dots lie along the sides of the frame: above, below, left, right. No turn, no mirror and no
/// shift takes them into each other.
const REFERENCE_DOTS_ALONG: [[f64; 2]; 4] = [[0.21, 0.8], [0.24, 0.75], [0.2, 0.73], [0.27, 0.78]];

/// Everything that does not change from shot to shot.
#[derive(Debug, Clone)]
pub(crate) struct SimulatedScene {
    pub slab_size_mm: Point,
    pub frame_mm: f64,
    pub grid: Grid,
    /// First corner and size of the upright rectangle around the nominal grid, half a lit pitch around it included.
    pub lit_origin_mm: Point,
    pub lit_size_mm: Point,
    pub slab_from_projector: SlabFromProjector,
    pub projector: Projector,
    pub view: CameraView,
    /// Where the camera is, slab mm; z is negative above the slab.
    pub eye_mm: [f64; 3],
    pub camera: Camera,
    pub board: Board,
    pub marks: Option<FrameMarks>,
    pub reference_dots: Vec<Point>,
    pub white: WhiteReference,
    /// Irradiance lost from the projector's brightest point to the corner of the frame, of itself.
    falloff: f64,
    /// Largest deviation of the white reference's reflectance from the rig file's, of itself.
    white_unevenness: f64,
    /// Whether the lab has no board.
    without_board: bool,
    /// Width of a camera pixel on the slab, mm.
    px_mm: f64,
    /// Blur of the projector's pixels (standard deviation), projector px; never sharper than can be rendered.
    pub projector_blur_px: f64,
}

impl SimulatedScene {
    /// Builds the bench around the lit points.
    pub(super) fn new(options: &SimulateOptions) -> Result<Self> {
        let centered = projector_view(options);
        let corners = grid_corners(options, -1.0).map(|p| centered.map(p));
        let lit = grid_corners(options, 0.0).map(|p| centered.map(p));
        let px_mm = options.pitch_mm / options.camera_px_per_sample;
        let (low, slab_size_mm) = slab(options, &corners);
        let lit_low: Point = std::array::from_fn(|a| fold(&lit, a, f64::min));
        let frame_mm = FRAME_PITCHES * options.pitch_mm;
        let slab_from_centered = Homography::similarity(1.0, low.map(|v| -v)).after(&centered);
        let (view, camera, eye_mm) = camera(options, slab_size_mm, frame_mm);
        // The projector lights all that the camera sees: beyond its raster a Gray code would begin again.
        let [right, lower] = camera.size_px.map(|s| s as f64);
        let mut lit: Vec<Point> = [[0.0, 0.0], [right, 0.0], [0.0, lower], [right, lower]]
            .into_iter()
            .filter_map(|q| view.slab_from_camera(q))
            .collect();
        lit.extend(outline(slab_size_mm, frame_mm));
        let raster = Raster::around(options, &slab_from_centered, &lit)?;
        // Of reflectances that are anywhere within what they are off by at most.
        let certified = options.white_unevenness / 3.0_f64.sqrt();
        let mut scene = Self {
            slab_size_mm,
            frame_mm,
            grid: raster.grid,
            lit_origin_mm: std::array::from_fn(|a| lit_low[a] - low[a]),
            lit_size_mm: std::array::from_fn(|a| fold(&lit, a, f64::max) - lit_low[a]),
            slab_from_projector: raster.slab_from_projector,
            projector: Projector { size_px: raster.size_px, principal_px: None },
            view,
            eye_mm,
            board: board(slab_size_mm, frame_mm, &camera, PRINT_BLUR_PX * px_mm),
            marks: options.frame_marks.then(|| marks(slab_size_mm, frame_mm)),
            camera,
            reference_dots: Vec::new(),
            white: WhiteReference { reflectance: WHITE_REFLECTANCE, relative_sd: certified },
            falloff: options.falloff,
            white_unevenness: options.white_unevenness,
            without_board: options.without_board,
            px_mm,
            projector_blur_px: options.projector_blur_px.max(FINEST_EDGE_PX * projector_px_per_camera_px(options)),
        };
        if !options.without_reference_dots {
            scene.reference_dots = scene.reference_dots(options);
        }
        Ok(scene)
    }

    /// The rig file: what a lab would know. The lens is not in it.
    pub(super) fn rig(&self, noise: Option<crate::capture::Noise>) -> Rig {
        Rig {
            format: crate::capture::FORMAT,
            camera: self.camera.clone(),
            noise,
            projector: self.projector.clone(),
            board: Some(self.board.clone()).filter(|_| !self.without_board),
            frame: self.marks.clone(),
            white_reference: self.white.clone(),
        }
    }

    /// The middle of the slab, mm.
    pub(super) fn center_mm(&self) -> Point {
        self.slab_size_mm.map(|s| 0.5 * s)
    }

    /// The camera's view of the board in pose number `n`: a third farther away, tilted by 25 degrees, towards one
    /// corner or another.
    pub(super) fn posed_view(&self, n: usize) -> CameraView {
        let (lens, m) = (self.view.lens, self.view.ideal_from_slab.matrix);
        let column = |j: usize| {
            [
                (m[0][j] - lens.center_px[0] * m[2][j]) / lens.focal_px,
                (m[1][j] - lens.center_px[1] * m[2][j]) / lens.focal_px,
                m[2][j],
            ]
        };
        let [x, y, t] = [column(0), column(1), column(2)];
        let length = |v: [f64; 3]| v.iter().map(|e| e * e).sum::<f64>().sqrt();
        let scale = 0.5 * (length(x) + length(y));
        let z = [x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]].map(|v| v / scale);
        // From the board's (x, y) about the slab's centre to slab (x, y, z): tilted about an axis that turns from pose
        // to pose.
        let (sin, cos) = (1.1 + 2.4 * n as f64).sin_cos();
        let (st, ct) = 25f64.to_radians().sin_cos();
        let tilt = [
            [cos * cos + ct * sin * sin, cos * sin * (1.0 - ct)],
            [cos * sin * (1.0 - ct), sin * sin + ct * cos * cos],
            [-st * sin, st * cos],
        ];
        let reach = 0.1 * (self.slab_size_mm[0] + 2.0 * self.frame_mm);
        let corner = [n, n / 2].map(|bit| if bit.is_multiple_of(2) { reach } else { -reach });
        let c = self.center_mm();
        // Along the line of sight, so that an oblique camera keeps it in view.
        let at = [c[0] + corner[0], c[1] + corner[1], 0.0];
        let place: [f64; 3] = std::array::from_fn(|a| at[a] + 0.35 * (at[a] - self.eye_mm[a]));
        let from = |v: [f64; 3], one: f64| {
            std::array::from_fn::<f64, 3, _>(|i| x[i] * v[0] + y[i] * v[1] + z[i] * v[2] + one * t[i])
        };
        let [a, b] = [0, 1].map(|k| from([tilt[0][k], tilt[1][k], tilt[2][k]], 0.0));
        let d = from(place, 1.0);
        let row = |i: usize| match i {
            2 => [a[2], b[2], d[2]],
            _ => [a, b, d].map(|v| lens.focal_px * v[i] + lens.center_px[i] * v[2]),
        };
        let about_center = Homography { matrix: [row(0), row(1), row(2)] };
        CameraView { ideal_from_slab: about_center.after(&Homography::similarity(1.0, [-c[0], -c[1]])), lens }
    }

    /// Albedo of the frame at `p` (mm): dark discs are printed on it.
    pub(super) fn frame_albedo(&self, p: Point) -> f64 {
        let Some(marks) = &self.marks else { return FRAME_ALBEDO };
        let radius = 0.5 * marks.diameter_mm;
        let cover = |m: &Point| {
            let inside = (radius - (p[0] - m[0]).hypot(p[1] - m[1])) / (PRINT_BLUR_PX * self.px_mm);
            if inside < -6.0 { 0.0 } else { patterns::normal_cdf(inside) }
        };
        FRAME_ALBEDO * (1.0 - MARK_DARKNESS * marks.marks_mm.iter().map(cover).sum::<f64>())
    }

    /// Whether a mark's edge may pass within `reach_mm` of `p` (mm).
    pub(super) fn near_mark(&self, p: Point, reach_mm: f64) -> bool {
        let near = |m: &Point, radius: f64| (p[0] - m[0]).hypot(p[1] - m[1]) <= radius + reach_mm;
        self.marks.as_ref().is_some_and(|f| f.marks_mm.iter().any(|m| near(m, 0.5 * f.diameter_mm)))
    }

    /// Whether `p` (mm) is on the sample.
    pub(super) fn on_sample(&self, p: Point) -> bool {
        (0..2).all(|a| p[a] >= 0.0 && p[a] <= self.slab_size_mm[a])
    }

    /// Whether `p` (mm) is on the sample or its frame.
    pub(super) fn on_frame_or_sample(&self, p: Point) -> bool {
        (0..2).all(|a| p[a] >= -self.frame_mm && p[a] <= self.slab_size_mm[a] + self.frame_mm)
    }

    /// Whether a rim of sample or frame passes within `reach_mm` of `p` (mm) along an axis.
    pub(super) fn near_rim(&self, p: Point, reach_mm: f64) -> bool {
        (0..2).any(|a| {
            let rims = [-self.frame_mm, 0.0, self.slab_size_mm[a], self.slab_size_mm[a] + self.frame_mm];
            rims.iter().any(|rim| (p[a] - rim).abs() <= reach_mm)
        })
    }

    /// Irradiance of projector white at `p` (mm): smooth, brightest a little beside the centre, arbitrary unit.
    pub(super) fn white_irradiance(&self, p: Point) -> [f64; 3] {
        let reach: f64 = self.slab_size_mm.iter().map(|s| (0.5 * s + self.frame_mm).powi(2)).sum();
        let r2: f64 = (0..2).map(|a| (p[a] - (0.48 + 0.05 * a as f64) * self.slab_size_mm[a]).powi(2)).sum();
        let falloff = 1.0 - self.falloff * r2 / reach;
        PROJECTOR_COLOR.map(|c| c * falloff)
    }

    /// Reflectance of the white reference at `p` (mm): the rig file's, but for a smooth unevenness that the lab does
    /// not know.
    pub(super) fn white_reflectance(&self, p: Point) -> [f64; 3] {
        let [x, y] = [0, 1].map(|a| p[a] / self.slab_size_mm[a] - 0.5);
        // A slope and a stain: between −1 and 1 over sample and frame, about 0 in the mean.
        let uneven = 0.9 * (2.1 * x - 1.3 * y + 0.11).sin() - 0.1;
        self.white.reflectance.map(|r| r * (1.0 + self.white_unevenness * uneven))
    }

    /// Where a dot falls when the pattern has moved by `drift_mm`, mm.
    pub(super) fn dot_mm(&self, dot: [usize; 2], drift_mm: Point) -> Point {
        let p = self.slab_from_projector.map(self.grid.dot_projector_px(dot));
        [p[0] + drift_mm[0], p[1] + drift_mm[1]]
    }

    /// Whether dots are discs: only those have an area of their own.
    pub(super) fn has_round_dots(&self) -> bool {
        self.grid.dot_area_projector_px2.is_some()
    }

    /// The light of that dot as it arrives.
    pub(super) fn beam(&self, dot: [usize; 2], drift_mm: Point) -> Beam {
        Beam {
            center_mm: self.dot_mm(dot, drift_mm),
            mm_from_px: self.slab_from_projector.jacobian(self.grid.dot_projector_px(dot)),
            side_px: self.grid.dot_projector_px as f64,
            round: self.has_round_dots(),
            blur_px: self.projector_blur_px,
        }
    }

    /// Displacement on the slab (mm) that moves the picture of its centre by `drift_px`.
    pub(super) fn drift_mm(&self, drift_px: Point) -> Point {
        let j = self.view.jacobian(self.center_mm());
        let det = j[0][0] * j[1][1] - j[0][1] * j[1][0];
        [(j[1][1] * drift_px[0] - j[0][1] * drift_px[1]) / det, (j[0][0] * drift_px[1] - j[1][0] * drift_px[0]) / det]
    }

    /// Two dots on each side of the frame.
    fn reference_dots(&self, options: &SimulateOptions) -> Vec<Point> {
        let (w, h, f) = (self.slab_size_mm[0], self.slab_size_mm[1], 0.5 * self.frame_mm);
        let [above, below, left, right] = REFERENCE_DOTS_ALONG;
        let sides =
            (0..2).flat_map(|k| [[above[k] * w, -f], [below[k] * w, h + f], [-f, left[k] * h], [w + f, right[k] * h]]);
        sides.map(|p| self.slab_from_projector.projector_from_slab(p).map(|v| whole_dot(options, v))).collect()
    }
}

/// The projector's pixels, numbered from the corner of a raster that is just large enough.
struct Raster {
    size_px: [usize; 2],
    grid: Grid,
    slab_from_projector: SlabFromProjector,
}

impl Raster {
    /// Covers `outline` (mm) and what the camera sees around it when it moves. Centred pixels count from the middle of
    /// the grid.
    fn around(options: &SimulateOptions, slab_from_centered: &Homography, outline: &[Point]) -> Result<Self> {
        let invert = |h: &Homography| h.inverse().ok_or_else(|| Error::internal("the projector's view is singular"));
        let centered_from_slab = invert(slab_from_centered)?;
        let lit: Vec<Point> = outline.iter().map(|&p| centered_from_slab.map(p)).collect();
        let step = options.step_projector_px.map(|step| step as f64);
        let margin = (options.camera_reach_px() + 4.0) * projector_px_per_camera_px(options);
        let half: Point = std::array::from_fn(|a| 0.5 * (options.grid[a] as f64 - 1.0) * step[a]);
        let origin: Point =
            std::array::from_fn(|a| whole_dot(options, (margin - fold(&lit, a, f64::min) - half[a]).ceil()));
        let center: Point = std::array::from_fn(|a| origin[a] + half[a]);
        let size_px =
            std::array::from_fn(|a| ((fold(&lit, a, f64::max) + center[a] + margin) as usize + 1).next_multiple_of(16));
        let grid = Grid {
            points: options.grid,
            origin_projector_px: origin,
            step_projector_px: step,
            dot_projector_px: options.dot_projector_px,
            dot_area_projector_px2: options.round_dots.then(|| PI / 4.0 * (options.dot_projector_px as f64).powi(2)),
        };
        let slab_from_projector = slab_from_centered.after(&Homography::similarity(1.0, center.map(|c| -c)));
        // The middle of the raster stays where it is.
        let lens = Lens {
            center_px: size_px.map(|s: usize| 0.5 * (s as f64 - 1.0)),
            focal_px: size_px[0] as f64,
            k1: options.projector_distortion,
            k2: 0.0,
        };
        let slab_from_projector = SlabFromProjector::new(invert(&slab_from_projector)?, lens)
            .ok_or_else(|| Error::internal("the projector's view is singular"))?;
        Ok(Self { size_px, grid, slab_from_projector })
    }
}

/// The nearest centre of a dot of whole pixels: on a pixel for an odd side, between two for an even one.
fn whole_dot(options: &SimulateOptions, px: f64) -> f64 {
    if options.dot_projector_px.is_multiple_of(2) { px.floor() + 0.5 } else { px.round() }
}

fn fold(points: &[Point], axis: usize, pick: fn(f64, f64) -> f64) -> f64 {
    points.iter().map(|p| p[axis]).reduce(pick).unwrap_or(0.0)
}

/// The outer corners of the frame.
fn outline(size: Point, frame: f64) -> [Point; 4] {
    let (x0, x1, y0, y1) = (-frame, size[0] + frame, -frame, size[1] + frame);
    [[x0, y0], [x1, y0], [x0, y1], [x1, y1]]
}

/// Corners of the grid about its centre, projector px: of its outer dots' centres with `more` −1, with half a step
/// around them with 0.
fn grid_corners(options: &SimulateOptions, more: f64) -> [Point; 4] {
    let [x, y] = [0, 1].map(|a| 0.5 * (options.grid[a] as f64 + more) * options.step_projector_px[a] as f64);
    [[-x, -y], [x, -y], [-x, y], [x, y]]
}

/// Projector px about the grid's centre to slab mm about the slab's centre.
fn projector_view(options: &SimulateOptions) -> Homography {
    let [mut x, y] = options.projector_px_mm();
    if options.projector_mirrored {
        x = -x;
    }
    let (sin, cos) = options.projector_turn_deg.to_radians().sin_cos();
    let keystone = |a: usize| KEYSTONE[a] / (options.grid[a].max(2) * options.step_projector_px[a]) as f64;
    Homography { matrix: [[x * cos, -y * sin, 0.0], [x * sin, y * cos, 0.0], [keystone(0), keystone(1), 1.0]] }
}

/// The slab's upper left corner and its size, mm, with room for windows and drift around the grid's corners.
fn slab(options: &SimulateOptions, corners: &[Point]) -> (Point, Point) {
    let px_mm = options.pitch_mm / options.camera_px_per_sample;
    // As far as dots drift; a third of a pitch more for rounding by anyone.
    let border = options.window_mm().map(|w| 0.5 * w + 0.35 * options.pitch_mm + options.drift_reach_px() * px_mm);
    let low: Point = std::array::from_fn(|a| fold(corners, a, f64::min) - border[a]);
    (low, std::array::from_fn(|a| fold(corners, a, f64::max) + border[a] - low[a]))
}

/// Options with as many pixels across a cell as make slab and frame fill the camera, where its size is given.
///
/// # Errors
/// [`Error::Setting`] for a size that takes pixels across a cell out of their range.
pub(crate) fn fitted(options: &SimulateOptions) -> Result<SimulateOptions> {
    let mut fitted = options.clone();
    let Some(wanted) = options.camera_size else { return Ok(fitted) };
    fitted.camera_size = None;
    let corners = grid_corners(options, -1.0).map(|p| projector_view(options).map(p));
    // Margins are pixels, all else grows with the scale: a few rounds end within a pixel.
    for round in 0..8 {
        let (_, size_mm) = slab(&fitted, &corners);
        let needed = camera(&fitted, size_mm, FRAME_PITCHES * options.pitch_mm).1.size_px;
        let scale = |a: usize| wanted[a] as f64 / needed[a] as f64;
        let smaller = if round < 5 { 1.0 } else { 0.9995 };
        if round >= 5 && scale(0).min(scale(1)) >= 1.0 {
            break;
        }
        fitted.camera_px_per_sample *= scale(0).min(scale(1)) * smaller;
    }
    let px = fitted.camera_px_per_sample;
    if !(1.0..=200.0).contains(&px) {
        let expected = "a camera with 1 to 200 pixels across an outgoing cell".into();
        let found = format!("{} × {} px, {px:.1} across a cell", wanted[0], wanted[1]);
        return Err(Error::Setting { setting: "camera_size", expected, found });
    }
    fitted.camera_size = Some(wanted);
    Ok(fitted)
}

/// A pinhole turned and tilted, its axis beside the slab's centre, its lens, and an image just large enough for slab
/// and frame.
fn camera(options: &SimulateOptions, size: Point, frame: f64) -> (CameraView, Camera, [f64; 3]) {
    let px_per_mm = options.camera_px_per_sample / options.pitch_mm;
    let extent_px = size.map(|s| (s + 2.0 * frame) * px_per_mm);
    let focal_px = (options.camera_distance * extent_px[0].max(extent_px[1])).round();
    let distance_mm = focal_px / px_per_mm;
    let [(sin_x, cos_x), (sin_y, cos_y)] = options.camera_tilt_deg.map(|t| t.to_radians().sin_cos());
    let (sin_r, cos_r) = options.camera_turn_deg.to_radians().sin_cos();
    // R = Ry · Rx · Rz(turn); a point of the plane is (x, y, 0) about the slab's centre, which is seen at `aim_px` from
    // the axis.
    let [a, b, c] =
        [[cos_r, -sin_r, 0.0], [cos_x * sin_r, cos_x * cos_r, -sin_x], [sin_x * sin_r, sin_x * cos_r, cos_x]];
    let rotation: [[f64; 3]; 3] = [
        std::array::from_fn(|k| cos_y * a[k] + sin_y * c[k]),
        b,
        std::array::from_fn(|k| -sin_y * a[k] + cos_y * c[k]),
    ];
    let aim_px = [0, 1].map(|k| CAMERA_AIM[k] * extent_px[k]);
    let center = [distance_mm * aim_px[0] / focal_px, distance_mm * aim_px[1] / focal_px, distance_mm];
    // The camera is where R · p + center = 0.
    let eye_mm = std::array::from_fn(|k| {
        let middle = if k < 2 { 0.5 * size[k] } else { 0.0 };
        middle - (0..3).map(|i| rotation[i][k] * center[i]).sum::<f64>()
    });
    let pinhole = Homography {
        matrix: std::array::from_fn(|i| {
            let row = [rotation[i][0], rotation[i][1], center[i]];
            row.map(|v| if i < 2 { focal_px * v } else { v })
        }),
    };
    let about_center = pinhole.after(&Homography::similarity(1.0, [-0.5 * size[0], -0.5 * size[1]]));
    // The centre of distortion is not quite where the rig believes the principal point to be.
    let off = [1.3, -0.9];
    let mut view = CameraView {
        ideal_from_slab: about_center,
        lens: Lens { center_px: off, focal_px, k1: options.distortion, k2: LENS_K2 * options.distortion },
    };
    let edge: Vec<Point> = (0..=40)
        .flat_map(|i| {
            let t = f64::from(i) / 40.0;
            let [a, b, c, d] = outline(size, frame);
            let between = |p: Point, q: Point| [p[0] + t * (q[0] - p[0]), p[1] + t * (q[1] - p[1])];
            [between(a, b), between(c, d), between(a, c), between(b, d)]
        })
        .map(|p| view.camera_from_slab(p))
        .collect();
    // The axis meets the middle of the picture, which is as large as the farther side demands.
    let reach = |a: usize| fold(&edge, a, f64::max).max(-fold(&edge, a, f64::min)) + image_margin_px(options);
    let size_px = options.camera_size.unwrap_or_else(|| [0, 1].map(|a| 2 * reach(a).ceil() as usize + 1));
    let shift = size_px.map(|s| 0.5 * (s as f64 - 1.0));
    view.ideal_from_slab = Homography::similarity(1.0, shift).after(&view.ideal_from_slab);
    view.lens.center_px = [off[0] + shift[0], off[1] + shift[1]];
    let principal_px = size_px.map(|s| 0.5 * (s as f64 - 1.0));
    let nominal_focal_px = (1.01 * focal_px).round();
    let corner2 = (principal_px[0].powi(2) + principal_px[1].powi(2)) / nominal_focal_px.powi(2);
    let camera = Camera {
        size_px,
        focal_px: nominal_focal_px,
        principal_px,
        response_curve: options.response_curve().told(options.rig_curve),
        vignetting: vec![-1.2 * options.vignetting / corner2, 0.2 * options.vignetting / (corner2 * corner2)],
    };
    (view, camera, eye_mm)
}

/// Size of a camera pixel in projector pixels, about: along the axis where these are the smaller.
fn projector_px_per_camera_px(options: &SimulateOptions) -> f64 {
    let [x, y] = options.projector_px_mm();
    options.pitch_mm / options.camera_px_per_sample / x.min(y)
}

/// What is seen around the frame, px: more when the camera moves.
fn image_margin_px(options: &SimulateOptions) -> f64 {
    IMAGE_MARGIN_PX + options.camera_reach_px().ceil()
}

/// A board over slab and frame: squares of at least some 13 camera px (OpenCV finds them down to about 8; calibration
/// boards lie a third farther away and tilted), as many along the longer side as fit, one even and one odd number of
/// inner corners.
fn board(size: Point, frame: f64, camera: &Camera, edge_blur_mm: f64) -> Board {
    let extent: Point = size.map(|s| s + 2.0 * frame);
    let px = camera.size_px[0].min(camera.size_px[1]) as f64 - 2.0 * IMAGE_MARGIN_PX;
    let fewer = ((px / 13.0).floor() as usize).clamp(6, 14);
    let square_mm = extent[0].min(extent[1]) / (fewer as f64 + 0.4);
    let along = usize::from(extent[1] > extent[0]);
    // A whole square of paper stays: OpenCV asks for a rim.
    let fit = (extent[along] / square_mm - 1.0).floor() as usize;
    let mut squares = [fewer; 2];
    squares[along] = fit - usize::from((fit + fewer).is_multiple_of(2));
    let inner_corners = squares.map(|n| n - 1);
    let origin_mm = std::array::from_fn(|a| -frame + 0.5 * (extent[a] - (inner_corners[a] as f64 - 1.0) * square_mm));
    Board { inner_corners, square_mm, origin_mm, edge_blur_mm }
}

/// Discs in the frame's corners and along its sides, away from the reference dots.
fn marks(size: Point, frame: f64) -> FrameMarks {
    let out = 0.6 * frame;
    let (diameter_mm, [w, h]) = (0.4 * frame, size);
    // As many as leave a diameter between them.
    let rows: [&[f64]; 3] = [&[0.08, 0.35, 0.5, 0.65, 0.92], &[0.08, 0.5, 0.92], &[0.5]];
    let fits = |row: &&&[f64]| row.windows(2).all(|t| (t[1] - t[0]) * w.min(h) > 2.0 * diameter_mm);
    let along = rows.iter().find(fits).unwrap_or(&rows[2]);
    let corners = [[-out, -out], [w + out, -out], [-out, h + out], [w + out, h + out]];
    let sides = along.iter().flat_map(|&t| [[t * w, -out], [t * w, h + out], [-out, t * h], [w + out, t * h]]);
    FrameMarks { marks_mm: corners.into_iter().chain(sides).collect(), diameter_mm }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_window_lies_on_the_sample_and_the_picture_holds_the_frame() {
        let options = SimulateOptions {
            grid: [9, 8],
            window: [9, 7],
            lit_pitch_mm: Some([1.1, 0.8]),
            ..SimulateOptions::default()
        };
        let scene = SimulatedScene::new(&options).unwrap();
        for dot in [[0, 0], [8, 0], [0, 7], [8, 7]] {
            let p = scene.slab_from_projector.map(scene.grid.dot_projector_px(dot));
            let half = [4.5, 3.5].map(|samples| samples * options.pitch_mm);
            assert!(scene.on_sample([p[0] - half[0], p[1] - half[1]]));
            assert!(scene.on_sample([p[0] + half[0], p[1] + half[1]]));
        }
        for p in outline(scene.slab_size_mm, scene.frame_mm) {
            let q = scene.view.camera_from_slab(p);
            assert!((0..2).all(|a| q[a] > 8.0 && q[a] < scene.camera.size_px[a] as f64 - 9.0), "{q:?}");
            let r = scene.slab_from_projector.projector_from_slab(p);
            assert!((0..2).all(|a| r[a] > 8.0 && r[a] < scene.projector.size_px[a] as f64 - 9.0), "{r:?}");
        }
        assert_eq!(scene.reference_dots.len(), 8);
        assert!(scene.reference_dots.iter().flatten().all(|v| v.fract() == 0.0));
    }

    #[test]
    fn lens_vignetting_and_falloff_have_the_strength_that_was_asked_for() {
        let scene = |distortion, vignetting, falloff| {
            SimulatedScene::new(&SimulateOptions { distortion, vignetting, falloff, ..SimulateOptions::default() })
                .unwrap()
        };
        let (real, ideal) = (scene(-0.05, 0.15, 0.12), scene(0.0, 0.0, 0.0));
        assert!((real.camera.vignetting_at([0.0, 0.0]) - 0.85).abs() < 1e-12);
        assert_eq!(ideal.camera.vignetting_at([0.0, 0.0]), 1.0);
        // Straight lines stay straight without distortion, and bend with it.
        let bend = |scene: &SimulatedScene| {
            let [w, h] = scene.slab_size_mm;
            let [a, b, c] = [[0.0, 0.0], [0.5 * w, 0.0], [w, h * 0.0]].map(|p| scene.view.camera_from_slab(p));
            ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])).abs() / (c[0] - a[0]).hypot(c[1] - a[1])
        };
        assert!(bend(&ideal) < 1e-9 && bend(&real) > 0.05, "{} {}", bend(&ideal), bend(&real));
        let corner = |scene: &SimulatedScene| scene.white_irradiance([-scene.frame_mm; 2])[0];
        // The brightest point is a little off the middle, so that the corner loses a little more or less.
        assert!((corner(&real) - 0.88).abs() < 0.02 && corner(&ideal) == 1.0, "{}", corner(&real));
    }

    #[test]
    fn the_camera_is_where_its_view_says_and_looks_beside_the_slab_s_middle() {
        for camera_tilt_deg in [[5.0, -3.0], [-20.0, 12.0], [0.0, 0.0]] {
            let options = SimulateOptions { camera_tilt_deg, camera_turn_deg: -14.0, ..SimulateOptions::default() };
            let scene = SimulatedScene::new(&options).unwrap();
            // The lens's axis is 1.3 and 0.9 px beside the picture's middle, which the pinhole's meets.
            let middle = scene.camera.size_px.map(|s| 0.5 * (s as f64 - 1.0));
            let lens = Lens { center_px: middle, ..scene.view.lens };
            let eye = CameraView { lens, ..scene.view }.eye_mm().unwrap();
            // `eye_mm` takes the homography apart by Zhang's method: exact for an ideal pinhole, to rounding.
            for a in 0..3 {
                assert!((eye[a] - scene.eye_mm[a]).abs() < 1e-6 * scene.eye_mm[2].abs(), "{eye:?} {:?}", scene.eye_mm);
            }
            let seen = scene.view.camera_from_slab(scene.center_mm());
            // 4 % of the width and -3 % of the height that sample and frame have in the picture.
            let extent = [0, 1].map(|a| (scene.slab_size_mm[a] + 2.0 * scene.frame_mm) / scene.px_mm);
            for (a, share) in [(0, 0.04), (1, -0.03)] {
                assert!((seen[a] - middle[a] - share * extent[a]).abs() < 0.1, "{seen:?} {middle:?} {extent:?}");
            }
        }
    }

    #[test]
    fn a_mirrored_projector_runs_backwards_and_a_turned_one_along_the_other_axis() {
        let steps = |projector_turn_deg, projector_mirrored| {
            let grid = [4, 3];
            let options =
                SimulateOptions { projector_turn_deg, projector_mirrored, grid, ..SimulateOptions::default() };
            let scene = SimulatedScene::new(&options).unwrap();
            let [o, x, y] = [[0, 0], [1, 0], [0, 1]].map(|dot| scene.dot_mm(dot, [0.0; 2]));
            [[x[0] - o[0], x[1] - o[1]], [y[0] - o[0], y[1] - o[1]]]
        };
        // Nominal steps are 0.5 and 0.625 mm; the keystone changes them by 2 % at most.
        for (turn, mirrored, expected) in [
            (0.0, false, [[0.5, 0.0], [0.0, 0.625]]),
            (0.0, true, [[-0.5, 0.0], [0.0, 0.625]]),
            (90.0, false, [[0.0, 0.5], [-0.625, 0.0]]),
            (180.0, true, [[0.5, 0.0], [0.0, -0.625]]),
        ] {
            let found = steps(turn, mirrored);
            for (a, b) in found.as_flattened().iter().zip(expected.as_flattened()) {
                assert!((a - b).abs() < 0.015, "{turn} {mirrored}: {found:?}");
            }
        }
    }

    #[test]
    fn no_turn_or_mirror_takes_the_reference_dots_into_each_other() {
        let scene = SimulatedScene::new(&SimulateOptions::default()).unwrap();
        let dots: Vec<Point> = scene.reference_dots.iter().map(|&q| scene.slab_from_projector.map(q)).collect();
        let [w, h] = scene.slab_size_mm;
        let turns: [fn(Point, Point) -> Point; 7] = [
            |[x, y], [w, h]| [w - x, h - y],
            |[x, y], [w, _]| [w - x, y],
            |[x, y], [_, h]| [x, h - y],
            |[x, y], [w, h]| [y * w / h, x * h / w],
            |[x, y], [w, h]| [w - y * w / h, x * h / w],
            |[x, y], [w, h]| [y * w / h, h - x * h / w],
            |[x, y], [w, h]| [w - y * w / h, h - x * h / w],
        ];
        for (k, turn) in turns.iter().enumerate() {
            let nearest = |p: Point| dots.iter().map(|q| (p[0] - q[0]).hypot(p[1] - q[1])).fold(f64::MAX, f64::min);
            let off = dots.iter().map(|&d| nearest(turn(d, [w, h]))).fold(0.0, f64::max);
            assert!(off > 0.2, "{k}: every dot is within {off} mm of another's image");
        }
    }

    #[test]
    fn drift_on_the_slab_is_seen_with_its_length_in_pixels() {
        let scene = SimulatedScene::new(&SimulateOptions::default()).unwrap();
        let (c, mm) = (scene.center_mm(), scene.drift_mm([0.3, -0.4]));
        let (a, b) = (scene.view.camera_from_slab(c), scene.view.camera_from_slab([c[0] + mm[0], c[1] + mm[1]]));
        assert!((b[0] - a[0] - 0.3).abs() < 1e-4 && (b[1] - a[1] + 0.4).abs() < 1e-4);
    }
}
