"""A capture folder to windows of responses, as a laboratory writes it with OpenCV and NumPy.

python pipeline.py CAPTURE OUT.npz. Photographs are linear, with a board, reference dots and the Gray code on the white
reference; `acquire import-matrix` takes the archive. One process a core over the shots.
"""

import concurrent.futures
import json
import multiprocessing
import os
import sys
import time
import tomllib

import cv2
import numpy as np
from PIL import Image

CORES = len(os.sched_getaffinity(0))
EXIF_IFD, EXPOSURE_TIME = 0x8769, 0x829A
LEAST_CONTRAST = 0.2  # of white minus black: a pixel in which a stripe's edge lies has less
scene = None  # what the forked processes share


class Scene:
    """Manifest, rig, and what registration and references add."""

    def __init__(self, folder):
        self.folder = folder
        self.capture = toml(os.path.join(folder, "capture.toml"))
        inside = os.path.join(folder, "calibration", "rig.toml")
        self.rig = toml(inside if os.path.exists(inside) else os.path.join(folder, "..", "calibration", "rig.toml"))
        camera = self.rig["camera"]
        if camera["response"] != "linear" or "noise" not in self.rig:
            raise SystemExit("linear photographs with [noise] in the rig are needed")
        self.focal, self.principal = camera["focal_px"], np.array(camera["principal_px"])
        self.vignetting = camera.get("vignetting", [])
        self.distortion = np.zeros(5)

    def shots(self, kind):
        return [s for s in self.capture["shots"] if s["kind"] == kind]

    def camera_matrix(self):
        return np.array([[self.focal, 0, self.principal[0]], [0, self.focal, self.principal[1]], [0, 0, 1.0]])

    def undistorted(self, px):
        """Camera px to normalized coordinates without distortion."""
        return cv2.undistortPoints(px.reshape(-1, 1, 2), self.camera_matrix(), self.distortion).reshape(px.shape)

    def camera_from_slab(self, mm):
        x = transformed(self.normal_from_slab, mm)
        r2 = (x**2).sum(-1, keepdims=True)
        return x * (1 + self.distortion[0] * r2 + self.distortion[1] * r2**2) * self.focal + self.principal

    def slab_from_camera(self, px):
        return transformed(np.linalg.inv(self.normal_from_slab), self.undistorted(px))

    def sensitivity(self, px):
        r2 = (((px - self.principal) / self.focal) ** 2).sum(-1)
        return 1 + sum(c * r2 ** (k + 1) for k, c in enumerate(self.vignetting))


def toml(path):
    with open(path, "rb") as file:
        return tomllib.load(file)


def transformed(homography, points):
    points = points @ homography[:, :2].T + homography[:, 2]
    return points[..., :2] / points[..., 2:]


def merged(shot):
    """Light in DN/s, BGR: the sum of the unsaturated code values over the sum of their times; NaN without any."""
    noise = scene.rig["noise"]
    light = None
    for photograph in shot["photographs"]:
        path = os.path.join(scene.folder, photograph["file"])
        secs = photograph.get("exposure_secs") or float(Image.open(path).getexif().get_ifd(EXIF_IFD)[EXPOSURE_TIME])
        codes = cv2.imread(path, cv2.IMREAD_UNCHANGED)
        good = codes < noise["saturation_dn"]
        signal = codes.astype(np.float32)
        signal -= np.float32(noise["black_dn"])
        signal *= good
        if light is None:
            light, total = signal, good * np.float32(secs)
        else:
            light += signal
            total += good * np.float32(secs)
    with np.errstate(all="ignore"):
        light /= total  # 0/0 is NaN
    return light


def sampled(light, px):
    """Light at camera px [..., 2], cubic."""
    flat = px.astype(np.float32).reshape(-1, px.shape[-2], 2)
    values = cv2.remap(light, flat, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).reshape(*px.shape[:-1], 3)
    values[((px < 0) | (px > np.array(light.shape[1::-1]) - 1)).any(-1)] = np.nan
    return values


def register_camera():
    """Lens distortion and the slab's homography from the board."""
    board = scene.rig["board"]
    picture = scene.board.mean(-1)
    picture = np.clip(picture / np.nanpercentile(picture, 99.5), 0, 1) ** (1 / 2.2)
    picture = np.nan_to_num(255 * picture, nan=255).astype(np.uint8)
    size = tuple(board["inner_corners"])
    found, corners = cv2.findChessboardCornersSB(picture, size, flags=cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY)
    if not found:
        raise SystemExit("no board")
    corners = corners.reshape(size[1], size[0], 2).astype(float)
    if corners[0, 0].sum() > corners[-1, -1].sum():  # the first corner is at the top left
        corners = corners[::-1, ::-1]
    column, row = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    mm = np.stack([column, row], -1) * board["square_mm"] + board["origin_mm"]
    flags = (cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_FOCAL_LENGTH | cv2.CALIB_FIX_PRINCIPAL_POINT
             | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3)
    points = np.pad(mm.reshape(-1, 1, 2), ((0, 0), (0, 0), (0, 1))).astype(np.float32)
    _, _, distortion, _, _ = cv2.calibrateCamera(
        [points], [corners.reshape(-1, 1, 2).astype(np.float32)], picture.shape[::-1], scene.camera_matrix(), np.zeros(5),
        flags=flags)
    scene.distortion = np.ravel(distortion)[:5]
    normal = scene.undistorted(corners.reshape(-1, 2))
    scene.normal_from_slab, _ = cv2.findHomography(mm.reshape(-1, 2), normal)
    residual = scene.camera_from_slab(mm) - corners
    return np.sqrt((residual**2).sum(-1).mean())


def gray_bit(pair):
    """One bit of the code at each pixel, and where it is sure."""
    light = [merged(shot).sum(-1) for shot in pair]
    contrast = (light[0] - light[1]) / scene.white_minus_black
    return contrast > 0, np.abs(contrast) > LEAST_CONTRAST


def gray_pairs():
    """(axis, bit, (pattern, inverse)), from the highest bit of each axis."""
    shots = {(s["axis"], s["bit"], s.get("inverse", False)): s for s in scene.shots("gray-code")}
    keys = sorted({k[:2] for k in shots}, key=lambda k: (k[0], -k[1]))
    return [(*k, (shots[*k, False], shots[*k, True])) for k in keys]


def register_projector(pairs, bits):
    """The homography from the projector to the slab, by the centroids of the code's cells."""
    lit = np.isfinite(scene.white_minus_black) & (scene.white_minus_black > 0.05 * np.nanmax(scene.white_minus_black))
    number = {"x": 0, "y": 0}
    last, finest = {}, {}
    for (axis, bit, _), (value, sure) in zip(pairs, bits):
        last[axis] = value ^ last[axis] if axis in last else value
        number[axis] = number[axis] * 2 + last[axis]
        finest[axis] = 1 << bit  # cells of so many projector px: the last one wins
        lit &= sure
    rows, columns = np.nonzero(lit)
    cell = np.stack([number[a][rows, columns] for a in "xy"], -1).astype(np.int64)
    size = np.array([finest[a] for a in "xy"])
    shape = cell.max(0) + 1
    flat = cell[:, 1] * shape[0] + cell[:, 0]
    normal = scene.undistorted(np.stack([columns, rows], -1).astype(float))
    count = np.bincount(flat, minlength=shape.prod())
    centroid = np.stack([np.bincount(flat, normal[:, k], shape.prod()) for k in (0, 1)], -1)
    centroid /= np.maximum(count, 1)[:, None]
    # Whole cells only: their neighbours are there, too.
    seen = (count.reshape(shape[::-1]) >= 0.7 * np.median(count[count > 0])).astype(np.uint8)
    whole = cv2.erode(seen, np.ones((3, 3)), borderType=cv2.BORDER_CONSTANT, borderValue=0).ravel().astype(bool)
    index = np.flatnonzero(whole)
    projector = np.stack([index % shape[0], index // shape[0]], -1) * size + (size - 1) / 2
    mm = transformed(np.linalg.inv(scene.normal_from_slab), centroid[index])
    scene.slab_from_projector, _ = cv2.findHomography(projector, mm, cv2.RANSAC, 0.1)
    return np.sqrt(((transformed(scene.slab_from_projector, projector) - mm) ** 2).sum(-1).mean())


def dot_areas_mm2(projector):
    """Area of the dots: their projector px², and how much a projector px covers there."""
    grid = scene.capture["grid"]
    step = 0.5 * np.eye(2)
    right, down = (transformed(scene.slab_from_projector, projector + s) - transformed(scene.slab_from_projector, projector - s)
                   for s in step)
    area = np.abs(right[:, 0] * down[:, 1] - right[:, 1] * down[:, 0])
    return area * grid.get("dot_area_projector_px2", grid["dot_projector_px"] ** 2)


def camera_from_projector(projector):
    return scene.camera_from_slab(transformed(scene.slab_from_projector, projector))


def drift_px(light):
    """How far the reference dots lie from where the registration has them, camera px: the median over the dots."""
    marks = np.array(scene.capture.get("reference_dots", {}).get("projector_px", []))
    if not len(marks):
        return np.zeros(2)
    expected = camera_from_projector(marks)
    spread = np.linalg.norm(camera_from_projector(marks + [1.0, 0.0]) - expected, axis=-1).mean()
    reach = int(np.ceil(scene.capture["grid"]["dot_projector_px"] * spread))
    moved = []
    for at in expected:
        column, row = np.round(at).astype(int)
        if min(column, row) < reach or column + reach >= light.shape[1] or row + reach >= light.shape[0]:
            continue
        patch = np.nan_to_num(light[row - reach : row + reach + 1, column - reach : column + reach + 1].sum(-1))
        near = np.arange(-reach, reach + 1)
        total = patch.sum()
        moved.append([patch.sum(0) @ near / total + column - at[0], patch.sum(1) @ near / total + row - at[1]])
    return np.median(moved, 0)


def rows_of(shot):
    """Windows of the responses of a lattice shot's dots, RGB, mm⁻², and where the dots are, mm."""
    light = merged(shot) - scene.sample_black
    grid, window = scene.capture["grid"], scene.capture["window"]
    dots = np.array(shot["dots"])
    projector = grid["origin_projector_px"] + dots * np.array(grid["step_projector_px"])
    drift = drift_px(light)
    centre = scene.slab_from_camera(camera_from_projector(projector) + drift)
    # The flux: light on the white reference over the dot's square.
    inside = (np.arange(5) - 2) / 5 * grid["dot_projector_px"]
    square = projector[:, None, None] + np.stack(np.meshgrid(inside, inside), -1)
    white = camera_from_projector(square) + drift
    white = (sampled(scene.white, white) / scene.sensitivity(white)[..., None]).mean((1, 2))
    irradiance = white / np.array(scene.rig["white_reference"]["reflectance"])[::-1]
    flux = irradiance * dot_areas_mm2(projector)[:, None]
    # Samples: a mean over as many points along each axis as the cell has camera px.
    nx, ny = window["samples"]
    per_sample = window["pitch_mm"] * scene.px_per_mm
    fine = int(np.ceil(per_sample))
    x, y = ((np.arange(n * fine) + 0.5) / fine - n / 2 for n in (nx, ny))
    points = centre[:, None, None] + np.stack(np.meshgrid(x, y), -1) * window["pitch_mm"]
    px = scene.camera_from_slab(points)
    values = sampled(light, px) / scene.sensitivity(px)[..., None]
    values = values.reshape(len(dots), ny, fine, nx, fine, 3).mean((2, 4))
    return dots, centre, (values / flux[:, None, None])[..., ::-1].astype(np.float32)


def pool():
    """One process a core, forked with what the scene knows by now."""
    return concurrent.futures.ProcessPoolExecutor(CORES, multiprocessing.get_context("fork"))


def main(folder, out):
    global scene
    last, stages = time.perf_counter(), {}

    def stage(name):
        nonlocal last
        last, stages[name] = time.perf_counter(), round(time.perf_counter() - last, 2)

    cv2.setNumThreads(1)  # forked processes hang where OpenCV has had threads
    scene = Scene(folder)
    kinds = ["board", "reference-white", "reference-black", "sample-black"]
    with pool() as workers:
        shots = [scene.shots(kind)[0] for kind in kinds]
        scene.board, white, reference_black, scene.sample_black = workers.map(merged, shots)
    scene.white = white - reference_black
    scene.white_minus_black = scene.white.sum(-1)
    stage("references")
    board_px = register_camera()
    middle = np.array(scene.capture["slab"]["size_mm"]) / 2
    scene.px_per_mm = np.linalg.norm(scene.camera_from_slab(middle + [1.0, 0]) - scene.camera_from_slab(middle))
    stage("board")
    pairs = gray_pairs()
    with pool() as workers:
        bits = list(workers.map(gray_bit, [pair for _, _, pair in pairs]))
    projector_mm = register_projector(pairs, bits)
    stage("gray code")
    nx, ny = scene.capture["grid"]["points"]
    wx, wy = scene.capture["window"]["samples"]
    response = np.full((ny, nx, wy, wx, 3), np.nan, np.float32)
    place = np.full((ny, nx, 2), np.nan)
    with pool() as workers:
        for dots, centre, rows in workers.map(rows_of, scene.shots("lattice"), chunksize=4):
            response[dots[:, 1], dots[:, 0]] = rows
            place[dots[:, 1], dots[:, 0]] = centre
    stage("lattice")
    np.savez(out, response=response, x_i_mm=place[..., 0], y_i_mm=place[..., 1],
             pitch_mm=scene.capture["window"]["pitch_mm"])
    stage("save")
    print(json.dumps({"board_px": round(board_px, 4), "projector_mm": round(projector_mm, 5), "stages": stages}))


main(sys.argv[1], sys.argv[2])
