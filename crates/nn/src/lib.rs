//! Small convolutional networks, forward and backward.
