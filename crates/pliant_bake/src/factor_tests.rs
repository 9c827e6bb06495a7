use super::*;
use crate::fem::{ANCHORED, FeMesh, Law};
use crate::{ordering, symbolic};
use pliant_modal::Element;
/// Makes a bar with its face x = 0 anchored, in elimination order.
pub(crate) fn bar(
    cells: [usize; 3],
    element: Element,
    average_pressure: bool,
) -> (FeMesh, BlockCsr, Symbolic) {
    let mesh = pliant_mesh::shapes::bar(cells, cells.map(|c| c as f64)).unwrap();
    let fe = FeMesh::new(&mesh, element);
    let graph = fe.graph(average_pressure);
    let keep: Vec<bool> = fe.nodes.iter().map(|p| p[0] > 0.0).collect();
    let order = ordering::nested_dissection(&graph, &fe.nodes, &keep);
    let mut number = vec![ANCHORED; fe.nodes.len()];
    for (new, &old) in order.iter().enumerate() {
        number[old as usize] = new as u32;
    }
    let permuted = graph.renumber(&number, order.len());
    let post = symbolic::postorder(&permuted);
    for (new, &old) in post.iter().enumerate() {
        number[order[old as usize] as usize] = new as u32;
    }
    let permuted = graph.renumber(&number, order.len());
    let symbolic = Symbolic::new(&permuted);
    let law = Law { lambda: 1.0, mu: 1.0, density: 1.0, average_pressure };
    let matrix = fe.assemble(&law, &number, &permuted);
    (fe, matrix, symbolic)
}

#[test]
fn solves_what_it_factored_whatever_the_threads() {
    for (cells, element, average) in [
        ([7, 5, 4], Element::Tet4, false),
        ([7, 5, 4], Element::Tet4, true),
        ([4, 3, 3], Element::Tet10, false),
        ([3, 3, 2], Element::Tet10, true),
        ([1, 1, 1], Element::Tet4, false),
    ] {
        let (_, matrix, symbolic) = bar(cells, element, average);
        let factor = Factor::new(symbolic, &matrix, &[]).unwrap();
        let n = matrix.dofs();
        for width in [1, 5, 16] {
            let x: Vec<f64> =
                (0..n * width).map(|i| ((i * 7919 + 13) % 1009) as f64 / 1009.0 - 0.5).collect();
            let mut b = vec![0.0; n * width];
            matrix.stiffness_times(&x, width, &mut b);
            factor.solve(&mut b, width);
            let worst = x.iter().zip(&b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(worst < 1e-10, "{cells:?} {element:?} {average}: {worst}");
        }
    }
}

#[test]
fn indefinite_is_refused_with_its_place() {
    let (_, matrix, symbolic) = bar([3, 2, 2], Element::Tet4, false);
    assert!(Factor::new(symbolic, &matrix, &[(7, -1e9)]).is_err());
}

/// Where a child of [`factorization_beside_faers`] finds what it has to factor, and with what.
const CASE: &str = "PLIANT_FACTOR_CASE";

/// Factors two bars on 1, 2 and 8 threads with ours and with faer's supernodal factorization, which
/// gets our ordering, and prints time, memory and whether the bits depend on the threads.
///
/// Each case is a process of its own, because memory that was freed is used again. Run it by
/// `cargo test --release -p pliant_bake --lib beside_faers -- --ignored --nocapture`.
#[test]
#[ignore = "measures, for a minute"]
fn factorization_beside_faers() {
    if let Ok(case) = std::env::var(CASE) {
        return factor_one(&case);
    }
    let program = std::env::current_exe().unwrap();
    println!("cells, threads, which: factor ms, 8 right-hand sides ms, peak MB, numbers stored");
    for cells in ["48,28,24", "96,20,18"] {
        for which in ["ours", "faer"] {
            let mut hashes = Vec::new();
            for threads in [1, 2, 8] {
                let mut best: Vec<f64> = Vec::new();
                for _ in 0..3 {
                    let child = std::process::Command::new(&program)
                        .args(["--ignored", "--exact", "factor::tests::factorization_beside_faers"])
                        .arg("--nocapture")
                        .env(CASE, format!("{which}:{threads}:{cells}"))
                        .output()
                        .unwrap();
                    let text = String::from_utf8_lossy(&child.stdout);
                    let line = text.lines().find_map(|l| l.split_once("case ")).unwrap().1;
                    let mut words = line.split(' ');
                    let hash = words.next().unwrap().to_owned();
                    let figures: Vec<f64> = words.map(|w| w.parse().unwrap()).collect();
                    hashes.push(hash);
                    for (best, figure) in best.iter_mut().zip(&figures) {
                        *best = best.min(*figure);
                    }
                    if best.is_empty() {
                        best = figures;
                    }
                }
                println!(
                    "{cells}, {threads}, {which}: {:.0}, {:.1}, {:.0}, {:.3e}",
                    best[0], best[1], best[2], best[3]
                );
            }
            let equal = hashes.iter().all(|h| *h == hashes[0]);
            println!("{cells}, {which}: the bits are equal on 1, 2 and 8 threads: {equal}");
            assert!(equal || which == "faer");
        }
    }
}

/// Prints what one factorization took: a hash of the solution, time, time of solves, memory, size.
fn factor_one(case: &str) {
    let mut words = case.split(':');
    let which = words.next().unwrap();
    let threads: usize = words.next().unwrap().parse().unwrap();
    let cells: Vec<usize> = words.next().unwrap().split(',').map(|word| word.parse().unwrap()).collect();
    let (_, matrix, symbolic) = bar([cells[0], cells[1], cells[2]], Element::Tet4, false);
    let n = matrix.dofs();
    let truth: Vec<f64> = (0..n * 8).map(|i| ((i * 7919 + 13) % 1009) as f64 / 1009.0 - 0.5).collect();
    let mut load = vec![0.0; n * 8];
    matrix.stiffness_times(&truth, 8, &mut load);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    let lower = (which == "faer").then(|| lower_triangle(&matrix));
    // Both get the structure of their factor beforehand: it is found once for all springs.
    let structure = lower.as_ref().map(|lower| faers_structure(lower.as_ref()));
    // The pool's threads and their stacks are not of the factorization.
    pool.install(|| (0..64).into_par_iter().for_each(|_| std::thread::yield_now()));
    let before = memory("VmRSS");
    let (x, factored, solved, stored) = pool.install(|| match lower.as_ref().zip(structure.as_ref()) {
        None => {
            let start = std::time::Instant::now();
            let factor = Factor::new(symbolic, &matrix, &[]).unwrap();
            let factored = start.elapsed();
            let mut x = load;
            let start = std::time::Instant::now();
            factor.solve(&mut x, 8);
            (x, factored, start.elapsed(), factor.values.len())
        }
        Some((lower, structure)) => faers(lower.as_ref(), structure, &load, threads),
    });
    let peak = memory("VmHWM") - before;
    let worst = x.iter().zip(&truth).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(worst < 1e-8, "{worst}");
    let bytes: Vec<u8> = x.iter().flat_map(|x| x.to_le_bytes()).collect();
    println!(
        "case {} {} {} {} {stored}",
        blake3::hash(&bytes).to_hex(),
        1e3 * factored.as_secs_f64(),
        1e3 * solved.as_secs_f64(),
        peak / 1024.0
    );
}

/// Returns the lower triangle of the stiffness.
fn lower_triangle(matrix: &BlockCsr) -> faer::sparse::SparseColMat<usize, f64> {
    let mut triplets = Vec::new();
    for row in 0..matrix.nodes() {
        for at in matrix.offsets[row]..matrix.offsets[row + 1] {
            let column = matrix.columns[at] as usize;
            for (entry, &value) in matrix.stiffness[9 * at..][..9].iter().enumerate() {
                let (i, j) = (3 * row + entry / 3, 3 * column + entry % 3);
                if i >= j {
                    triplets.push(faer::sparse::Triplet::new(i, j, value));
                }
            }
        }
    }
    faer::sparse::SparseColMat::try_new_from_triplets(matrix.dofs(), matrix.dofs(), &triplets).unwrap()
}

type FaersStructure = faer::sparse::linalg::cholesky::SymbolicCholesky<usize>;

/// Returns the structure of faer's supernodal factor in the order that the matrix has.
fn faers_structure(lower: faer::sparse::SparseColMatRef<'_, usize, f64>) -> FaersStructure {
    use faer::sparse::linalg::{SupernodalThreshold, cholesky};
    let n = lower.nrows();
    let order: Vec<usize> = (0..n).collect();
    let order = faer::perm::Perm::new_checked(order.clone().into(), order.into(), n);
    cholesky::factorize_symbolic_cholesky(
        lower.symbolic(),
        faer::Side::Lower,
        cholesky::SymmetricOrdering::Custom(order.as_ref()),
        cholesky::CholeskySymbolicParams {
            supernodal_flop_ratio_threshold: SupernodalThreshold::FORCE_SUPERNODAL,
            ..Default::default()
        },
    )
    .unwrap()
}

/// Factors and solves with faer's supernodal factorization.
fn faers(
    lower: faer::sparse::SparseColMatRef<'_, usize, f64>,
    symbolic: &FaersStructure,
    load: &[f64],
    threads: usize,
) -> (Vec<f64>, std::time::Duration, std::time::Duration, usize) {
    let par = if threads == 1 { Par::Seq } else { Par::rayon(threads) };
    let n = lower.nrows();
    let start = std::time::Instant::now();
    let mut values = vec![0.0; symbolic.len_val()];
    let scratch = symbolic.factorize_numeric_llt_scratch::<f64>(par, Default::default());
    let mut memory = MemBuffer::new(scratch);
    let factor = symbolic
        .factorize_numeric_llt(
            &mut values,
            lower,
            faer::Side::Lower,
            Default::default(),
            par,
            MemStack::new(&mut memory),
            Default::default(),
        )
        .unwrap();
    let factored = start.elapsed();
    drop(memory);
    let mut x = Mat::from_fn(n, 8, |i, j| load[8 * i + j]);
    let mut memory = MemBuffer::new(symbolic.solve_in_place_scratch::<f64>(8, par));
    let start = std::time::Instant::now();
    factor.solve_in_place_with_conj(faer::Conj::No, x.as_mut(), par, MemStack::new(&mut memory));
    let solved = start.elapsed();
    let rows = (0..n).flat_map(|i| (0..8).map(move |j| (i, j)));
    (rows.map(|(i, j)| x[(i, j)]).collect(), factored, solved, symbolic.len_val())
}

/// Returns a line of the process's status, kB. Zero where there is none.
fn memory(line: &str) -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let value = status.lines().find_map(|l| l.strip_prefix(line)?.strip_prefix(':'));
    value.and_then(|v| v.split_whitespace().next()?.parse().ok()).unwrap_or_default()
}
