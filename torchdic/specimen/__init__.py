"""The specimen: a learnable index on a grid of voxels, and its values between voxel centres."""
