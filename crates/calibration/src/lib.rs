//! Pairs to the map from camera to robot: plan, fit, apply, report.
