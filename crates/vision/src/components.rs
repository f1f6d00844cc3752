//! Connected components of a mask, as runs of its rows.

/// Pixels `start..end` of one row.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Run {
    pub y: usize,
    pub start: usize,
    pub end: usize,
}

/// Pixels of a component.
pub(crate) fn area(runs: &[Run]) -> usize {
    runs.iter().map(|run| run.end - run.start).sum()
}

/// Connected components (8 neighbours) of the pixels inside, joined run by run (union-find), in the order of their first pixels.
pub(crate) fn components(width: usize, height: usize, inside: impl Fn(usize, usize) -> bool) -> Vec<Vec<Run>> {
    let mut runs: Vec<Run> = Vec::new();
    let mut parent: Vec<usize> = Vec::new();
    let mut above = 0..0; // runs of the row above
    for y in 0..height {
        let begin = runs.len();
        let mut x = 0;
        while x < width {
            if !inside(x, y) {
                x += 1;
                continue;
            }
            let start = x;
            while x < width && inside(x, y) {
                x += 1;
            }
            let index = runs.len();
            runs.push(Run { y, start, end: x });
            parent.push(index);
            while above.start < above.end && runs[above.start].end < start {
                above.start += 1; // left of this run, and so of all that follow
            }
            for other in above.clone().take_while(|&other| runs[other].start <= x) {
                let (a, b) = (root(&mut parent, index), root(&mut parent, other));
                parent[a.max(b)] = a.min(b);
            }
        }
        above = begin..runs.len();
    }
    let mut slot = vec![usize::MAX; runs.len()];
    let mut components: Vec<Vec<Run>> = Vec::new();
    for (i, run) in runs.iter().enumerate() {
        let root = root(&mut parent, i);
        if slot[root] == usize::MAX {
            slot[root] = components.len();
            components.push(Vec::new());
        }
        components[slot[root]].push(*run);
    }
    components
}

fn root(parent: &mut [usize], mut i: usize) -> usize {
    while parent[i] != i {
        parent[i] = parent[parent[i]];
        i = parent[i];
    }
    i
}

#[cfg(test)]
mod tests {
    use super::*;

    fn areas(rows: &[&str]) -> Vec<usize> {
        let inside = |x: usize, y: usize| rows[y].as_bytes()[x] == b'#';
        components(rows[0].len(), rows.len(), inside)
            .iter()
            .map(|runs| area(runs))
            .collect()
    }

    #[test]
    fn components_join_across_corners_and_bridges() {
        assert_eq!(areas(&["##..#", "..#..", "#...#", "#.#.#", "#####"]), [3, 1, 10]);
        assert_eq!(areas(&["#.#.#.#", "#######", ".......", "###.###"]), [11, 3, 3]);
        assert_eq!(areas(&["....", "...."]), [0usize; 0]);
    }
}
