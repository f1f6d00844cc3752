//! Tensors, and pictures that hand out their rows.

/// A dense float tensor in NHWC order.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tensor {
    /// Pictures.
    pub n: usize,
    /// Rows.
    pub h: usize,
    /// Columns.
    pub w: usize,
    /// Channels.
    pub c: usize,
    /// `n * h * w * c` values, channels fastest.
    pub data: Vec<f32>,
}

impl Tensor {
    /// A tensor of zeros.
    pub fn zeros(n: usize, h: usize, w: usize, c: usize) -> Self {
        Self {
            n,
            h,
            w,
            c,
            data: vec![0.0; n * h * w * c],
        }
    }

    /// Index into `data` of channel 0 of a pixel.
    pub fn index(&self, n: usize, y: usize, x: usize) -> usize {
        ((n * self.h + y) * self.w + x) * self.c
    }

    /// The channels of a pixel.
    pub fn pixel(&self, n: usize, y: usize, x: usize) -> &[f32] {
        let start = self.index(n, y, x);
        &self.data[start..start + self.c]
    }

    /// Panics where `data` does not have the length that the shape says: every entry into a network checks this.
    pub(crate) fn assert_shape(&self) {
        assert_eq!(
            self.data.len(),
            self.n * self.h * self.w * self.c,
            "a tensor's data must have n * h * w * c values"
        );
    }
}

/// A picture that hands out its rows as floats, so that 12 megapixels never exist as floats at once.
pub trait RowSource: Sync {
    /// Rows.
    fn height(&self) -> usize;
    /// Columns.
    fn width(&self) -> usize;
    /// Channels.
    fn channels(&self) -> usize;
    /// Writes row `y`, `width * channels` values, channels fastest.
    fn row(&self, y: usize, out: &mut [f32]);
    /// Row `y` as bytes, where the picture has them and a byte `b` is the value `b * 2 / 255 - 1`.
    fn bytes(&self, _y: usize) -> Option<&[u8]> {
        None
    }
}

/// The first picture of a tensor.
impl RowSource for Tensor {
    fn height(&self) -> usize {
        self.h
    }

    fn width(&self) -> usize {
        self.w
    }

    fn channels(&self) -> usize {
        self.c
    }

    fn row(&self, y: usize, out: &mut [f32]) {
        let start = self.index(0, y, 0);
        out.copy_from_slice(&self.data[start..start + self.w * self.c]);
    }
}
