"""Bone fit: 9-DOF bone coefficients, within limits, that bring a skinned face to a target."""
