//! Image to screws: coarse, fine, centre, locate; image to calibration marker.
