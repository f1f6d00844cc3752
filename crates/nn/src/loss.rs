//! Softmax, and the cross-entropy of its classes.

use std::ops::Range;

use crate::Tensor;

/// Turns the logits in `channels` of every pixel into probabilities that add up to 1.
pub fn softmax(tensor: &mut Tensor, channels: Range<usize>) {
    assert!(!channels.is_empty() && channels.end <= tensor.c);
    for pixel in tensor.data.chunks_exact_mut(tensor.c) {
        let classes = &mut pixel[channels.clone()];
        let sum = exponentials(classes);
        for value in classes {
            *value /= sum;
        }
    }
}

/// Softmax cross-entropy over the pixels of a batch.
///
/// # Arguments
/// * `channels` – the channels of `logits` that are classes.
/// * `target` – the class of each pixel (0 is `channels.start`), `n * h * w` values.
/// * `weight` – the weight of each pixel; 0 ignores it.
/// * `grad` – receives the gradient of the mean loss in `channels`; other channels stay as they are.
///   Where its shape differs from that of `logits` it is first replaced by zeros.
///
/// # Returns
/// The weighted mean loss in nats; 0 where all weights are 0.
pub fn softmax_cross_entropy(
    logits: &Tensor,
    channels: Range<usize>,
    target: &[u8],
    weight: &[f32],
    grad: &mut Tensor,
) -> f32 {
    let pixels = logits.n * logits.h * logits.w;
    assert!(!channels.is_empty() && channels.end <= logits.c);
    assert_eq!(target.len(), pixels, "a target class for each pixel");
    assert_eq!(weight.len(), pixels, "a weight for each pixel");
    if (grad.n, grad.h, grad.w, grad.c) != (logits.n, logits.h, logits.w, logits.c) {
        *grad = Tensor::zeros(logits.n, logits.h, logits.w, logits.c);
    }
    let total: f64 = weight.iter().map(|&w| f64::from(w)).sum();
    let scale = if total > 0.0 { 1.0 / total } else { 0.0 };
    let mut loss = 0.0;
    let rows = logits
        .data
        .chunks_exact(logits.c)
        .zip(grad.data.chunks_exact_mut(logits.c));
    for ((logit, grad), (&class, &weight)) in rows.zip(target.iter().zip(weight)) {
        let grad = &mut grad[channels.clone()];
        if weight == 0.0 {
            grad.fill(0.0);
            continue;
        }
        let class = usize::from(class);
        assert!(class < grad.len(), "target class {class} has no channel");
        let logit = &logit[channels.clone()];
        grad.copy_from_slice(logit);
        let highest = grad.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let sum = exponentials(grad);
        loss += f64::from(weight) * f64::from(sum.ln() + highest - logit[class]);
        let factor = (f64::from(weight) * scale) as f32;
        for value in grad.iter_mut() {
            *value *= factor / sum;
        }
        grad[class] -= factor;
    }
    (loss * scale) as f32
}

/// Replaces logits by their exponentials, the highest scaled to 1, and returns the sum.
fn exponentials(classes: &mut [f32]) -> f32 {
    let highest = classes.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let mut sum = 0.0;
    for value in classes {
        *value = (*value - highest).exp();
        sum += *value;
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn softmax_normalises_only_its_channels() {
        let mut tensor = Tensor {
            n: 1,
            h: 1,
            w: 1,
            c: 4,
            data: vec![5.0, 0.0, 1000.0, 1000.0],
        };
        softmax(&mut tensor, 1..4);
        assert_eq!(tensor.data, [5.0, 0.0, 0.5, 0.5]);
    }

    #[test]
    fn cross_entropy_gradient_is_the_slope_of_the_loss() {
        let logits = Tensor {
            n: 1,
            h: 1,
            w: 3,
            c: 3,
            data: vec![0.3, -0.2, 0.9, 1.5, 0.1, 0.4, 9.0, 9.0, 9.0],
        };
        let (target, weight) = ([1, 0, 1], [2.0, 0.5, 0.0]);
        let mut grad = Tensor::default();
        softmax_cross_entropy(&logits, 1..3, &target, &weight, &mut grad);
        for i in 0..logits.data.len() {
            let shifted = |by: f32| {
                let mut moved = logits.clone();
                moved.data[i] += by;
                softmax_cross_entropy(&moved, 1..3, &target, &weight, &mut Tensor::default())
            };
            let slope = (shifted(1e-2) - shifted(-1e-2)) / 2e-2;
            assert!((slope - grad.data[i]).abs() < 1e-4, "{i}: {slope} {grad:?}");
        }
    }
}
