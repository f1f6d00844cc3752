use std::path::Path;
struct P;
impl training::Progress for P { fn report(&self, phase: &str, done: u64, total: u64, loss: Option<f32>) { if done % 200 == 0 || done == total || phase == "rendering" && done % 10 == 0 { eprintln!("{phase} {done}/{total} {loss:?}"); } } }
fn main() {
    let a: Vec<String> = std::env::args().collect();
    let n = |i: usize| a[i].parse::<f64>().unwrap();
    let s = training::TrainSettings { units: n(2) as u64, coarse_steps: n(3) as usize, fine_steps: n(4) as usize, learning_rate: n(5) as f32, tuning_faces: n(6) as u64, ..Default::default() };
    let r = training::train(&s, Path::new(&a[1]), &P).unwrap();
    println!("{}", serde_json::to_string_pretty(&r).unwrap());
}
