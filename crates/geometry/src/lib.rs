//! Frames, points, transforms, the camera model, RGB-D frames and their files.
