"""Convert poses from other systems, make quaternions continuous, average noisy rotations and interpolate poses."""

import numpy as np

from armlab.lie import euler, quaternion, se3, so3


def main() -> None:
    np.set_printoptions(precision=4, suppress=True)
    # ABB: millimetres and a wxyz quaternion, rounded to six decimals. Nikon: millimetres and three angles in degrees.
    abb_mm, abb_quaternion = np.array([515.0, 0.0, 712.0]), [0.707107, 0.0, 0.707107, 0.0]
    nikon = np.array([1125.153, -683.551, 614.108, 12.5, -3.0, 91.2])
    T_base_tool = se3.from_rp(quaternion.to_matrix(abb_quaternion), abb_mm / 1000)
    T_base_cam = se3.from_rp(euler.from_rpy(np.deg2rad(nikon[3:]), "xyz"), nikon[:3] / 1000)
    T_cam_tool = se3.inv(T_base_cam) @ T_base_tool
    angles = np.rad2deg(euler.to_rpy(T_cam_tool[:3, :3], "zyx"))
    print("tool pose in camera axes:", T_cam_tool[:3, 3], "m,", angles, "deg about z, y, x")

    t = np.linspace(0, 10, 1001)  # a continuous rotation whose quaternion jumps if w ≥ 0 is enforced
    R = so3.from_axis_angle([1.0, 0.0, 1.0], 2 * t)
    q = quaternion.from_matrix(R)
    smooth = quaternion.continuous(q)
    steps = [np.abs(np.diff(values, axis=0)).max() for values in (q, smooth)]
    print("largest quaternion step with w >= 0, and with continuous signs:", *steps)
    print("in xyzw order (ROS, SciPy):", np.roll(smooth[-1], -1))

    noisy = R[100] @ so3.exp(0.02 * np.random.default_rng(0).standard_normal((400, 3)))
    off = so3.angle(R[100], noisy)
    print("mean error", off.mean(), "rad, error of the mean rotation", so3.angle(R[100], so3.mean(noisy)), "rad")

    s = np.linspace(0, 1, 5)
    for path in ("linear", "screw"):
        print(path, "path, heights:", se3.interpolate(T_base_cam, T_base_tool, s, path)[:, 2, 3], "m")
    print("camera heading:", np.rad2deg(so3.xy_angle(np.eye(3), T_base_cam[:3, :3])), "deg")


if __name__ == "__main__":
    main()
