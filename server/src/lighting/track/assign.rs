//! Optimal assignment by the Hungarian method (Kuhn 1955; shortest augmenting paths after Jonker & Volgenant 1987),
//! for a fixed small size and without allocating. Sixteen rows cost some microseconds; a crate would bring its own
//! matrix type and allocate in every frame.

/// Rows and columns.
pub(super) const MOST: usize = 16;

/// Costs of giving a row a column; finite.
pub(super) type Costs = [[f64; MOST]; MOST];

/// The column of each row in the assignment of least total cost.
pub(super) fn assign(costs: &Costs) -> [usize; MOST] {
    // Column 0 stands for "none yet"; rows and columns count from 1.
    let mut row_price = [0.0; MOST + 1];
    let mut column_price = [0.0; MOST + 1];
    let mut row_of = [0; MOST + 1];
    for row in 1..=MOST {
        row_of[0] = row;
        let mut from = [0; MOST + 1];
        let mut end = augment(costs, &mut row_price, &mut column_price, &row_of, &mut from);
        while end != 0 {
            row_of[end] = row_of[from[end]];
            end = from[end];
        }
    }
    let mut column_of = [0; MOST];
    for column in 1..=MOST {
        column_of[row_of[column] - 1] = column - 1;
    }
    column_of
}

/// Finds the cheapest path from the row in `row_of[0]` to a free column, which is returned; `from` leads back.
fn augment(
    costs: &Costs,
    row_price: &mut [f64; MOST + 1],
    column_price: &mut [f64; MOST + 1],
    row_of: &[usize; MOST + 1],
    from: &mut [usize; MOST + 1],
) -> usize {
    let mut least = [f64::INFINITY; MOST + 1];
    let mut visited = [false; MOST + 1];
    let mut at = 0;
    while row_of[at] != 0 {
        visited[at] = true;
        let row = row_of[at];
        let (mut step, mut next) = (f64::INFINITY, 0);
        for column in 1..=MOST {
            if visited[column] {
                continue;
            }
            let reduced = costs[row - 1][column - 1] - row_price[row] - column_price[column];
            if reduced < least[column] {
                (least[column], from[column]) = (reduced, at);
            }
            if least[column] < step {
                (step, next) = (least[column], column);
            }
        }
        for column in 0..=MOST {
            if visited[column] {
                row_price[row_of[column]] += step;
                column_price[column] -= step;
            } else {
                least[column] -= step;
            }
        }
        at = next;
    }
    at
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Least total cost over all permutations of the first `n` columns.
    fn exhaustive(costs: &Costs, n: usize, row: usize, used: &mut [bool; MOST]) -> f64 {
        if row == n {
            return 0.0;
        }
        let mut best = f64::INFINITY;
        for column in 0..n {
            if !used[column] {
                used[column] = true;
                best = best.min(costs[row][column] + exhaustive(costs, n, row + 1, used));
                used[column] = false;
            }
        }
        best
    }

    #[test]
    fn is_as_good_as_trying_everything() {
        let mut state = 0x9E37_79B9_7F4A_7C15u64;
        let mut random = || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 40) as f64 / 1e4
        };
        for n in 1..=7 {
            for _ in 0..20 {
                // Outside the first n rows and columns every choice costs the same, too much to be mixed in.
                let mut costs = [[1e6; MOST]; MOST];
                costs[..n].iter_mut().for_each(|row| row[..n].iter_mut().for_each(|cost| *cost = random()));
                costs[n..].iter_mut().for_each(|row| row[n..].fill(0.0));
                let columns = assign(&costs);
                let mut seen = [false; MOST];
                columns.iter().for_each(|column| assert!(!std::mem::replace(&mut seen[*column], true)));
                let total: f64 = columns.iter().enumerate().map(|(row, column)| costs[row][*column]).sum();
                let best = exhaustive(&costs, n, 0, &mut [false; MOST]);
                assert!((total - best).abs() < 1e-9 * best.max(1.0), "{n}: {total} against {best}");
            }
        }
    }

    #[test]
    fn greed_would_be_wrong() {
        // The cheapest pair forces the dearest one.
        let mut costs = [[50.0; MOST]; MOST];
        (costs[0][0], costs[0][1], costs[1][0], costs[1][1]) = (1.0, 2.0, 2.0, 40.0);
        assert_eq!(assign(&costs)[..2], [1, 0]);
    }
}
