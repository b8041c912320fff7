"""Hand-eye calibration from images of a board: corners, intrinsics, and board poses with covariance.

OpenCV (extra ``vision``) detects the corners. Intrinsics and poses minimise the reprojection error ``u - proj(T p)``.
Let s be the standard deviation of this error. For known intrinsics, the covariance of each pose is
``s^2 (J_i^T J_i)^-1``. The covariance of the shared intrinsics is ``s^2 (sum_i J_k^T (I - P_i) J_k)^-1``, with P_i the
projection onto the columns of J_i. The two errors are independent, because the intrinsics are determined by the part
of the residuals that the poses cannot explain (bundle adjustment: Triggs et al. 2000).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from armlab._display import Shown
from armlab._numbers import numbers
from armlab.calibrate.hand_eye import Pair, equation_of, fit_hand_eye
from armlab.errors import ConfigError, MissingExtra, NotConverged, NotExcited, ShapeError
from armlab.estimation import Fit
from armlab.lie import se3, so3
from armlab.models import HandEye

LEAST_IMAGES, LEAST_FOR_INTRINSICS = 3, 6  # minimum number of images
FOCAL = 0.05  # largest relative standard deviation of the focal length
FEW_CORNERS = 6  # minimum number of board corners for a pose
UNLIKE = 4.0  # ratio to the median reprojection error above which corners count as wrong
TRIED, FEW_MARKERS = 10, 4  # images in the search for a dictionary; number of markers that identify the dictionary
SURE = 2.5  # standard deviations of chi^2 above which a misfit is significant
AMBIGUOUS = 2.0  # minimum error ratio of the two pose solutions of a tag
FORMS = (
    "charuco:COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY] (squares, m), checkerboard:COLUMNSxROWS:SQUARE (inner corners, "
    "m), apriltag:FAMILY:SIZE[:ID] or aruco:DICTIONARY:SIZE[:ID] (m)"
)
DICTIONARIES = ("4X4_1000", "5X5_1000", "6X6_1000", "7X7_1000", "ARUCO_ORIGINAL", "APRILTAG_36h11", "ARUCO_MIP_36h12")


def opencv() -> Any:
    try:
        import cv2
    except ImportError:
        raise MissingExtra(
            "Expected OpenCV for board images, but it is not installed. Install it: pip install 'armlab[vision]'."
        ) from None
    return cv2


@dataclass(frozen=True)
class _Board:
    """Parsed board specification such as ``charuco:7x5:0.03:0.022``."""

    kind: str
    columns: int = 1
    rows: int = 1
    square: float = 0.0  # side of a square, or of a tag [m]
    marker: float = 0.0  # side of a marker [m]
    dictionary: str = ""
    tag: int | None = None

    @classmethod
    def of(cls, text: str) -> _Board:
        kind, *parts = str(text).split(":")
        size = re.fullmatch(r"(\d+)x(\d+)", parts[0]) if parts else None
        try:
            if kind in ("charuco", "checkerboard") and size and len(parts) in ((3, 4) if kind == "charuco" else (2,)):
                lengths = [float(part) for part in parts[1:3]]
                board = cls(kind, int(size[1]), int(size[2]), *lengths, dictionary="".join(parts[3:]))
            elif kind in ("apriltag", "aruco") and len(parts) in (2, 3):
                name = f"APRILTAG_{parts[0]}" if kind == "apriltag" else parts[0]
                board = cls(kind, square=float(parts[1]), dictionary=name, tag=int(parts[2]) if parts[2:] else None)
            else:
                raise ValueError
        except ValueError:
            raise ConfigError(f"Expected a board as {FORMS}, got {text!r}.") from None
        if not 0 < board.square < np.inf or (kind == "charuco" and not 0 < board.marker < board.square):
            raise ConfigError(f"Expected lengths above 0 m and a marker smaller than the square, got {text!r}.")
        if kind == "charuco" and min(board.columns, board.rows) < 3:
            raise ConfigError(f"Expected a ChArUco board with at least 3x3 squares, got {text!r}.")
        if kind == "checkerboard" and (min(board.columns, board.rows) < 3 or (board.columns + board.rows) % 2 == 0):
            raise ConfigError(
                "Expected at least 3x3 inner corners, with an even number along one side and an odd number along the "
                f"other, got {text!r}. This board looks the same upside down. Use a different size, or a ChArUco board."
            )
        return board


@dataclass(frozen=True, eq=False, repr=False)
class BoardPoses(Shown):
    """Poses of a board in images.

    Attributes
    ----------
    T_cam_marker : ndarray, shape (N, 4, 4)
        Poses; NaN if the board was not found. Axes as in OpenCV: the camera z axis points forward, and the board x axis
        points along a row.
    cov : ndarray, shape (N, 6, 6)
        Covariance of [v; w] for known intrinsics: v in camera axes [m], w in board axes [rad].
    valid : ndarray of bool, shape (N,)
        Mask of images with a pose.
    failures : dict
        Reason for each missing pose, keyed by the name (or number) of the image.
    camera_matrix : ndarray, shape (3, 3)
        Camera matrix K [pixel], given or calibrated.
    distortion : ndarray, shape (k,)
        Distortion coefficients k1, k2, p1, p2, ... as in OpenCV.
    sigma : float
        RMS reprojection error per axis [pixel], corrected for degrees of freedom.
    intrinsics_cov : ndarray, shape (d, d)
        Covariance of fx, fy, cx, cy, k1, k2, p1, p2; d = 0 if the intrinsics were given.
    sensitivity : ndarray, shape (N, 6, d)
        Derivative of each pose with respect to the intrinsics.
    """

    T_cam_marker: np.ndarray
    cov: np.ndarray
    valid: np.ndarray
    failures: Mapping[str, str]
    camera_matrix: np.ndarray
    distortion: np.ndarray
    sigma: float
    intrinsics_cov: np.ndarray
    sensitivity: np.ndarray

    def report(self) -> str:
        """Return a summary of the intrinsics, the reprojection error, and the reason for each missing pose."""
        K = self.camera_matrix
        values = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *self.distortion]
        names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
        sd = [*np.sqrt(np.diag(self.intrinsics_cov)), *[np.nan] * len(values)]
        words = [f"{name} {x:.6g}" + (f" +- {s:.2g}" if s == s else "") for name, x, s in zip(names, values, sd)]
        how = "Calibrated" if len(self.intrinsics_cov) else "Given"
        lines = [
            f"{np.count_nonzero(self.valid)} of {len(self.valid)} images show the board; reprojection error "
            f"{self.sigma:.3g} pixel per axis.",
            f"{how} intrinsics [pixel]: {', '.join(words)}.",
        ]
        return "\n".join([*lines, *(f"{name}: {why}" for name, why in self.failures.items())])


def board_poses(
    images: Sequence[np.ndarray] | Mapping[str, np.ndarray],
    board: str,
    *,
    intrinsics: tuple[ArrayLike, ArrayLike] | None = None,
) -> BoardPoses:
    """Detect a calibration board in images; return its poses with covariance, and the camera intrinsics.

    Parameters
    ----------
    images : sequence or mapping of ndarray, shape (H, W) or (H, W, 3), 8 bit
        Images from one camera, all of the same size; mapping keys are image names.
    board : str
        ``charuco:7x5:0.03:0.022`` (number of squares along x and y, sides of a square and of a marker [m], optionally
        the dictionary; default: detected), ``checkerboard:8x5:0.025`` (number of inner corners, side of a square [m]),
        ``apriltag:36h11:0.05`` or ``aruco:4X4_50:0.05`` (side of the black square [m], optionally the tag number). The
        origin is OpenCV's first corner of a ChArUco board, the first inner corner of a checkerboard, or the centre of
        a tag.
    intrinsics : tuple, optional
        Camera matrix (3, 3) [pixel] and distortion coefficients as in OpenCV. Default: calibrated (fx, fy, cx, cy, k1,
        k2, p1, p2) from at least six images. Required for tags.

    Returns
    -------
    BoardPoses

    Raises
    ------
    MissingExtra : OpenCV is not installed.
    ConfigError : an invalid board specification.
    ShapeError : images of a wrong type or of different sizes.
    NotExcited : too few images with a board (the message states the reasons), or images that do not determine the
        intrinsics.

    References
    ----------
    Zhang, IEEE PAMI 22(11), 2000 (intrinsics); Collins and Bartoli, IJCV 109, 2014 (poses of a square).
    """
    wanted, cv2 = _Board.of(board), opencv()
    known = None if intrinsics is None else _checked_intrinsics(*intrinsics)
    named = images if isinstance(images, Mapping) else {str(k): image for k, image in enumerate(images)}
    names, pixels = list(named), [_gray(cv2, image, name) for name, image in named.items()]
    sizes = {image.shape for image in pixels}
    if len(sizes) > 1:
        listed = ", ".join(f"{w} x {h}" for h, w in sorted(sizes))
        raise ShapeError(
            f"Expected images of equal size from one camera, got {listed}. Calibrate each camera separately."
        )
    find = _detector(cv2, wanted, pixels)
    found = {name: find(image) for name, image in zip(names, pixels)}
    size = (pixels[0].shape[1], pixels[0].shape[0]) if pixels else (0, 0)
    return poses_of_corners(found, size, known, is_tag=wanted.kind in ("apriltag", "aruco"))


Corners = tuple[np.ndarray, np.ndarray]  # (K, 3) on the board [m], (K, 2) in the image [pixel]


def poses_of_corners(
    found: Mapping[str, Corners | str],
    size: tuple[int, int],
    intrinsics: tuple[ArrayLike, ArrayLike] | None = None,
    is_tag: bool = False,
) -> BoardPoses:
    """Return the board poses from the corners in each image; a string in place of corners gives a failure reason."""
    cv2 = opencv()
    failures, seen = _separated(found)
    if intrinsics is None and is_tag:
        raise NotExcited(
            "Expected intrinsics for a tag, whose four corners do not determine the intrinsics, got none. Pass the "
            "intrinsics (--intrinsics FILE), or use a board.", ["intrinsics"], ["4 corners per image"],
        )  # fmt: skip
    while True:  # until no image is an outlier
        _require_images(seen, found, failures, LEAST_IMAGES if intrinsics else LEAST_FOR_INTRINSICS)
        if intrinsics is None:
            K, dist, poses = _calibrated(cv2, seen, size)
        else:
            K, dist = (np.asarray(one, dtype=float) for one in intrinsics)
            why, poses = _separated({name: _pose(cv2, *one, K, dist, is_tag) for name, one in seen.items()})
            failures |= why
        parts = {name: _linear(cv2, *seen[name], *pose, K, dist) for name, pose in poses.items()}
        rms = {name: float(np.sqrt(np.mean(r**2))) for name, (r, _, _) in parts.items()}
        usual = float(np.median(list(rms.values()))) if rms else 0.0
        wrong = {name: value for name, value in rms.items() if value > UNLIKE * usual}
        failures |= {
            name: f"reprojection error of {value:.2g} pixel, but {usual:.2g} in other images: wrong corners"
            for name, value in wrong.items()
        }
        seen = {name: corners for name, corners in seen.items() if name in parts and name not in wrong}
        if not wrong:
            break
    _require_images(seen, found, failures, LEAST_IMAGES)
    return _result(list(found), poses, parts, failures, K, dist, estimated=intrinsics is None)


def _separated(results: Mapping[str, Any]) -> tuple[dict[str, str], dict[str, Any]]:
    """Split the results into failures, whose values are strings, and successes."""
    failures = {name: one for name, one in results.items() if isinstance(one, str)}
    return failures, {name: one for name, one in results.items() if name not in failures}


def fit_hand_eye_images(
    T_base_tool: ArrayLike,
    seen: BoardPoses,
    *,
    setup: Literal["eye_to_hand", "eye_in_hand"] = "eye_to_hand",
    noise_robot: ArrayLike | None = None,
    robust: bool = False,
) -> Fit[HandEye]:
    """Calibrate the poses of the camera and a board from robot poses and images of the board at rest.

    The function calls `fit_hand_eye` with the covariance of each board pose. Corner errors within an image may be
    correlated, and the arm may be inaccurate. If the residuals are larger than the pose covariances explain, the
    covariance C of the result is therefore scaled to ``C chi^2 / dof`` (Birge ratio). The shared error of estimated
    intrinsics is added: ``C + S C_k S^T``, with S the sensitivity of the result to the intrinsics.

    Parameters
    ----------
    T_base_tool : array_like, shape (N, 4, 4)
        Robot pose for each image; poses of images without a detected board are ignored.
    seen : BoardPoses
        Result of `board_poses`.
    setup : {"eye_to_hand", "eye_in_hand"}
        Fixed camera, or camera on the tool.
    noise_robot : array_like, optional
        Noise of the robot poses, as in `fit_hand_eye`; recommended, because a camera is often more accurate than the
        arm.
    robust : bool
        Detect and exclude outliers. `Fit.outliers` has one entry per image with a detected board.

    Returns
    -------
    Fit of a `models.HandEye`
        See `fit_hand_eye`.

    Raises
    ------
    ShapeError : the number of robot poses differs from the number of images.
    NotExcited, NotConverged : see `fit_hand_eye`.
    """
    T, N = numbers(T_base_tool, "T_base_tool", ShapeError), len(seen.valid)
    if T.shape != (N, 4, 4):
        raise ShapeError(f"Expected a robot pose for each of the {N} images, (N, 4, 4), got {T.shape}.")
    A, B, cov = T[seen.valid], seen.T_cam_marker[seen.valid], seen.cov[seen.valid]
    noise = numbers(noise_robot, "noise_robot", ShapeError) if noise_robot is not None else None
    if noise is not None and noise.ndim == 3 and len(noise) == N:
        noise = noise[seen.valid]
    fit = fit_hand_eye(A, B, setup=setup, noise=cov, noise_robot=noise, robust=robust, offset=0.0)
    keep = ~fit.outliers
    inside = noise if noise is None or noise.ndim < 3 else noise[keep]
    ratio, d = _misfit(fit, A[keep], B[keep], cov[keep], inside, setup), len(seen.intrinsics_cov)
    notes = seen.report().splitlines()
    if ratio > 1.0:
        notes.append(
            f"Pose residuals are {np.sqrt(ratio):.2g} times as large as expected "
            "from the corner errors; standard deviations are scaled by this factor."
        )
    D, S, sd = seen.sensitivity[seen.valid][keep], np.zeros((12, d)), np.sqrt(np.diag(seen.intrinsics_cov))
    for k in range(d):
        moved = _plus(B[keep], 0.1 * sd[k] * D[:, :, k])
        other = fit_hand_eye(A[keep], moved, setup=setup, noise=cov[keep], noise_robot=inside, offset=0.0)
        S[:, k] = _difference(fit.value, other.value) / (0.1 * sd[k])
    total = ratio * fit.cov + S @ seen.intrinsics_cov @ S.T
    return replace(fit, cov=total, notes=(*fit.notes, *notes))


def _misfit(fit: Fit[HandEye], A: np.ndarray, B: np.ndarray, cov: np.ndarray, noise_robot: Any, setup: str) -> float:
    """Return chi^2 per degree of freedom if it is significantly above 1, otherwise 1."""
    equation, _ = equation_of(A, B, setup, cov, noise_robot)
    X, Y = np.asarray(fit.value.X), fit.value.Y
    (one,) = equation.evaluate(Pair(X[:3, :3], X[:3, 3], Y[:3, :3], Y[:3, 3]))
    S = np.broadcast_to(np.asarray(one.cov), (*one.r.shape, 6))
    squares = np.einsum("ni,ni->", one.r, np.linalg.solve(S, one.r[:, :, None])[:, :, 0])
    dof = max(one.r.size - 12, 1)
    return float(squares) / dof if squares > dof + SURE * np.sqrt(2.0 * dof) else 1.0


def _plus(T: np.ndarray, x: np.ndarray) -> np.ndarray:
    return se3.from_rp(T[:, :3, :3] @ so3.exp(x[:, 3:]), T[:, :3, 3] + x[:, :3])


def _difference(one: HandEye, other: HandEye) -> np.ndarray:
    """Return the step (12,) between two calibration results, v in the parent's axes, w in the child's axes."""
    parts = []
    for a, b in ((np.asarray(one.X), np.asarray(other.X)), (one.Y, other.Y)):
        parts += [b[:3, 3] - a[:3, 3], so3.log(a[:3, :3].T @ b[:3, :3])]
    return np.concatenate(parts)


def _require_images(seen: Mapping[str, Any], found: Mapping[str, Any], failures: Mapping[str, str], least: int) -> None:
    if len(seen) >= least:
        return
    listed = "; ".join(f"{name}: {why}" for name, why in list(failures.items())[:5])
    raise NotExcited(
        f"Expected the board in at least {least} images, but it was found in {len(seen)} of {len(found)}"
        + (f" ({listed}). " if listed else ". ")
        + ("Take more images" if len(seen) else "Check --board")
        + (", or pass the intrinsics." if least == LEAST_FOR_INTRINSICS else "."),
        [f"everything: {len(seen)} images"],
        [f"{len(seen)} images (at least {least} required)"],
    )


def _gray(cv2: Any, image: Any, name: str) -> np.ndarray:
    pixels = np.asarray(image)
    channels = 1 if pixels.ndim == 2 else pixels.shape[2] if pixels.ndim == 3 else 0
    if pixels.dtype != np.uint8 or channels not in (1, 3, 4):
        raise ShapeError(
            f"Expected 8-bit images of shape (H, W) or (H, W, 3), got {pixels.dtype} of shape {pixels.shape} for "
            f"{name}."
        )
    if channels == 1:
        return pixels.reshape(pixels.shape[:2])
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY if channels == 3 else cv2.COLOR_BGRA2GRAY)


def _detector(cv2: Any, board: _Board, images: Sequence[np.ndarray]) -> Any:
    """Return a function that detects the corners in an image; if detection fails, the function returns the reason as a
    string."""
    if board.kind == "checkerboard":
        return lambda image: _checkerboard(cv2, board, image)
    if board.kind == "charuco":
        detector = _charuco_detector(cv2, board, images)
        return lambda image: _charuco_points(cv2, detector, image)
    detector = cv2.aruco.ArucoDetector(_dictionary(cv2, board.dictionary), _refined(cv2))
    return lambda image: _tag(detector, board, image)


def _dictionary(cv2: Any, name: str) -> Any:
    wanted = name.upper().removeprefix("DICT_")
    known = {one.removeprefix("DICT_").upper(): one for one in dir(cv2.aruco) if one.startswith("DICT_")}
    if wanted not in known:
        names = ", ".join(sorted(known))
        raise ConfigError(f"Expected the name of an OpenCV ArUco dictionary, got {name!r}. Known: {names}.")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, known[wanted]))


def _refined(cv2: Any) -> Any:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.cornerRefinementMinAccuracy, parameters.cornerRefinementMaxIterations = 1e-4, 100
    return parameters


def _charuco_detector(cv2: Any, board: _Board, images: Sequence[np.ndarray]) -> Any:
    """Return the detector whose dictionary and pattern find the most markers in the first images."""
    count = board.columns * board.rows // 2

    def markers(name: str, image: np.ndarray) -> int:
        ids = cv2.aruco.ArucoDetector(_dictionary(cv2, name)).detectMarkers(image)[1]
        return 0 if ids is None else int(np.count_nonzero(ids < count))

    name, shown = board.dictionary or DICTIONARIES[0], list(images[:1])
    for image in images[:TRIED] if not board.dictionary else ():
        found = {one: markers(one, image) for one in DICTIONARIES}
        name = max(found, key=lambda one: found[one])
        if found[name] >= FEW_MARKERS:
            shown = [image]
            break
    detectors = []
    for legacy in (False, True) if board.rows % 2 == 0 else (False,):  # before OpenCV 4.6, the layout was different
        made = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square, board.marker, _dictionary(cv2, name))
        made.setLegacyPattern(legacy)
        detectors.append(cv2.aruco.CharucoDetector(made))
    return max(detectors, key=lambda one: sum(_corner_count(one, image) for image in shown))


def _corner_count(detector: Any, image: np.ndarray) -> int:
    corners = detector.detectBoard(image)[0]
    return 0 if corners is None else len(corners)


def _charuco_points(cv2: Any, detector: Any, image: np.ndarray) -> Corners | str:
    corners, ids, _, markers = detector.detectBoard(image)
    if ids is None or len(ids) < FEW_CORNERS:
        count, known = (0 if ids is None else len(ids)), (0 if markers is None else len(markers))
        return f"{count} board corners (minimum {FEW_CORNERS}), {known} board markers"
    places = np.asarray(detector.getBoard().getChessboardCorners(), dtype=float)[ids.ravel()]
    if np.linalg.matrix_rank(places[:, :2] - places[:, :2].mean(axis=0), 1e-6) < 2:
        return "all detected corners are collinear"
    return places, _sharpened(cv2, detector.getBoard(), image, places, corners.reshape(-1, 2))


def _sharpened(cv2: Any, board: Any, image: np.ndarray, places: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the refined corners; unrefined corners have correlated errors of about 0.1 pixel."""
    apart = np.linalg.norm(places[:, None] - places[None], axis=2) + 1e9 * np.eye(len(places))
    pixels = np.linalg.norm(corners[:, None] - corners[None], axis=2)
    scale = float(np.min(pixels[apart < 1.1 * board.getSquareLength()], initial=np.inf)) / board.getSquareLength()
    free = 0.5 * (board.getSquareLength() - board.getMarkerLength()) * scale
    width = int(np.clip(0.65 * free, 2, 11)) if np.isfinite(free) else 2
    end = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-4)
    return cv2.cornerSubPix(image, corners.astype(np.float32), (width, width), (-1, -1), end).astype(float)


def _checkerboard(cv2: Any, board: _Board, image: np.ndarray) -> Corners | str:
    there, corners = cv2.findChessboardCornersSB(image, (board.columns, board.rows), flags=cv2.CALIB_CB_ACCURACY)
    if not there:
        return f"no checkerboard with {board.columns} x {board.rows} inner corners, all of which must be visible"
    u = corners.reshape(board.rows, board.columns, 2).astype(float)
    if _inner_square(image, u) > _inner_square(image, u[::-1, ::-1]):  # the first square must be dark
        u = u[::-1, ::-1]
    x, y = np.meshgrid(np.arange(board.columns), np.arange(board.rows))
    places = board.square * np.stack([x, y, 0 * x], axis=2).reshape(-1, 3)
    return places, u.reshape(-1, 2)


def _inner_square(image: np.ndarray, u: np.ndarray) -> float:
    """Return the brightness of the first inner square."""
    x, y = np.rint(u[:2, :2].reshape(4, 2).mean(axis=0)).astype(int)
    return float(np.mean(image[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]))


def _tag(detector: Any, board: _Board, image: np.ndarray) -> Corners | str:
    corners, ids, _ = detector.detectMarkers(image)
    found = [] if ids is None else ids.ravel().tolist()
    wanted = [k for k, one in enumerate(found) if board.tag is None or one == board.tag]
    if len(wanted) != 1:
        if not found:
            return f"no tag of {board.dictionary}"
        listed = ", ".join(map(str, found))
        return (
            f"several tags {listed}: choose one, {board.kind}:...:{found[0]}"
            if wanted
            else f"tag {board.tag} not among {listed}"
        )
    h = board.square / 2.0
    places = np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]])
    return places, corners[wanted[0]].reshape(4, 2).astype(float)


def _checked_intrinsics(camera_matrix: ArrayLike, distortion: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    K, dist = numbers(camera_matrix, "the camera matrix", ShapeError), numbers(distortion, "distortion", ShapeError)
    if K.shape != (3, 3) or not np.isfinite(K).all() or not (K[0, 0] > 0 and K[1, 1] > 0 and K[2, 2] == 1.0):
        raise ShapeError(f"Expected a camera matrix (3, 3) [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {K.tolist()}.")
    if dist.size not in (0, 4, 5, 8, 12, 14) or not np.isfinite(dist).all():
        raise ShapeError(f"Expected 0, 4, 5, 8, 12 or 14 OpenCV distortion coefficients, got {dist.size}.")
    return K, dist.ravel() if dist.size else np.zeros(4)


def _calibrated(cv2: Any, seen: Mapping[str, Corners], size: tuple[int, int]) -> tuple[Any, Any, dict[str, Any]]:
    """Return the camera matrix, the distortion, and the rotation vectors and positions of the board."""
    places = [board.astype(np.float32) for board, _ in seen.values()]
    corners = [image.astype(np.float32) for _, image in seen.values()]
    end = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    try:
        _, K, dist, turns, shifts = cv2.calibrateCamera(
            places, corners, size, None, None, flags=cv2.CALIB_FIX_K3, criteria=end
        )[:5]
    except cv2.error as error:
        raise NotConverged(
            f"Expected images that determine the intrinsics, but OpenCV reports: {str(error).splitlines()[-1]}. Tilt "
            "the board more, or pass the intrinsics."
        ) from None
    poses = {name: (r.ravel(), t.ravel()) for name, r, t in zip(seen, turns, shifts)}
    return K, dist.ravel()[:4], poses


def _pose(
    cv2: Any, places: np.ndarray, corners: np.ndarray, K: np.ndarray, dist: np.ndarray, is_tag: bool
) -> tuple[np.ndarray, np.ndarray] | str:
    """Return the rotation vector and position of the board or, if the pose is ambiguous, the reason as a string."""
    way = cv2.SOLVEPNP_IPPE_SQUARE if is_tag else cv2.SOLVEPNP_IPPE
    _, turns, shifts, errors = cv2.solvePnPGeneric(places, corners, K, dist, flags=way)
    found = sorted(zip(errors.ravel().tolist(), range(len(turns))))
    if is_tag and len(found) > 1 and found[1][0] < AMBIGUOUS * found[0][0]:
        return (
            f"two poses fit the corners of the tag, with errors of {found[0][0]:.2g} and {found[1][0]:.2g} pixel; move "
            "closer, or use a board"
        )
    start = found[0][1]
    end = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-14)
    r, t = cv2.solvePnPRefineLM(places, corners, K, dist, turns[start].copy(), shifts[start].copy(), end)
    return r.ravel(), t.ravel()


def _linear(
    cv2: Any, places: np.ndarray, corners: np.ndarray, r: np.ndarray, t: np.ndarray, K: np.ndarray, dist: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the residuals (2K,) and their derivatives with respect to the pose (2K, 6) and the intrinsics (2K, 8)."""
    projected, J = cv2.projectPoints(places, r, t, K, dist)
    by_turn = J[:, :3] @ so3.left_jacobian_inv(-r)
    residual = (corners - projected.reshape(-1, 2)).ravel()
    return residual, np.hstack([J[:, 3:6], by_turn]), J[:, 6:14]


def _result(
    names: Sequence[str],
    poses: Mapping[str, tuple[np.ndarray, np.ndarray]],
    parts: Mapping[str, tuple[np.ndarray, np.ndarray, np.ndarray]],
    failures: Mapping[str, str],
    K: np.ndarray,
    dist: np.ndarray,
    estimated: bool,
) -> BoardPoses:
    kept = [name for name in names if name in parts and name not in failures]
    d, N = (8 if estimated else 0), len(names)
    squares, count = 0.0, 0
    T, cov, D, information = np.full((N, 4, 4), np.nan), np.full((N, 6, 6), np.nan), np.full((N, 6, d), np.nan), 0.0
    for name in kept:
        (r, t), (residual, J, Jk) = poses[name], parts[name]
        squares, count = squares + residual @ residual, count + len(residual)
        at = names.index(name)
        T[at] = se3.from_rp(so3.exp(r), t)
        cov[at] = np.linalg.inv(J.T @ J)
        if d:
            D[at] = -cov[at] @ (J.T @ Jk)
            rest = Jk + J @ D[at]
            information = information + rest.T @ rest
    s2 = squares / max(count - 6 * len(kept) - d, 1)
    shared = s2 * np.linalg.inv(information) if d else np.zeros((0, 0))
    if d and not np.sqrt(max(shared[0, 0], 0.0)) < FOCAL * K[0, 0]:
        raise NotExcited(
            f"Expected images that determine the focal length to {100 * FOCAL:.0f} %, got {K[0, 0]:.4g} +- "
            f"{np.sqrt(shared[0, 0]):.2g} pixel. Tilt the board by 20 to 40 degrees to both sides, or pass the "
            "intrinsics.", ["focal length"], [f"relative standard deviation {np.sqrt(shared[0, 0]) / K[0, 0]:.2g}"],
        )  # fmt: skip
    whole = {name: failures[name] for name in names if name in failures}
    valid = np.array([name in kept for name in names])
    return BoardPoses(T, s2 * cov, valid, whole, K, dist, float(np.sqrt(s2)), shared, D)
