"""Evaluation by KITTI's official rules: NumPy in float64, without a device."""
