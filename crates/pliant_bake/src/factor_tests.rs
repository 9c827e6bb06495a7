use super::*;
use crate::element::Element;
use crate::fem::{ANCHORED, FeMesh, Law};
use crate::{ordering, symbolic};
use std::time::{Duration, Instant};

/// Processor time of this thread: the machine is shared.
pub(crate) struct Cpu(f64);
impl Cpu {
    pub(crate) fn now() -> Self {
        let text = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap();
        Self(text.split_whitespace().next().unwrap().parse().unwrap())
    }
    pub(crate) fn elapsed(&self) -> Duration {
        Duration::from_nanos((Self::now().0 - self.0) as u64)
    }
}


/// A bar with its face x = 0 anchored, in elimination order.
pub(crate) fn bar(cells: [usize; 3], element: Element, average_pressure: bool) -> (FeMesh, BlockCsr, Symbolic) {
    let mesh = pliant_mesh::shapes::bar(cells, cells.map(|c| c as f64)).unwrap();
    let t = Instant::now();
    let fe = FeMesh::new(&mesh, element);
    let graph = fe.graph(average_pressure);
    let keep: Vec<bool> = fe.nodes.iter().map(|p| p[0] > 0.0).collect();
    let t1 = Instant::now();
    let order = ordering::nested_dissection(&graph, &fe.nodes, &keep);
    let t2 = Instant::now();
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
    let t3 = Instant::now();
    let law = Law { lambda: 1.0, mu: 1.0, density: 1.0, average_pressure };
    let matrix = fe.assemble(&law, &number, &permuted);
    let t4 = Instant::now();
    println!(
        "{} dofs, {} tets: graph {:?} nd {:?} symbolic {:?} assemble {:?}; nnz(L) {:.2e} ops {:.2e} supernodes {} tasks {}",
        3 * order.len(), mesh.tets.len(), t1 - t, t2 - t1, t3 - t2, t4 - t3,
        symbolic.values as f64, symbolic.operations, symbolic.supernodes.len(), symbolic.tasks.len()
    );
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
        assert_eq!(factor.dofs(), n);
        for width in [1, 5, 16] {
            let x: Vec<f64> = (0..n * width).map(|i| ((i * 7919 + 13) % 1009) as f64 / 1009.0 - 0.5).collect();
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

#[test]
#[ignore = "a measurement"]
fn speed() {
    rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap().install(speed_one);
}
fn speed_one() {
    for (cells, element, avg) in [([20, 20, 20], Element::Tet4, false), ([40,15,15], Element::Tet4, false), ([12, 12, 12], Element::Tet10, false), ([20,20,20], Element::Tet4, true)] {
        let (_, matrix, symbolic) = bar(cells, element, avg);
        for _ in 0..2 {
            let t = Cpu::now();
            let ops = symbolic.operations;
            let factor = Factor::new(symbolic.clone(), &matrix, &[]).unwrap();
            let e = t.elapsed();
            let mut x = vec![1.0; matrix.dofs() * 16];
            let t = Cpu::now();
            factor.forward(&mut x, 16);
            let f = t.elapsed();
            let t = Cpu::now();
            factor.backward(&mut x, 16);
            println!("factor {e:?} {:.1} GF/s, forward {f:?}, backward {:?}", ops / e.as_secs_f64() * 1e-9, t.elapsed());
        }
    }
}

#[test]
#[ignore = "a measurement"]
fn dense_speed() {
    for (m, n, k) in [(512, 128, 128), (1000, 128, 300), (1000, 1000, 300), (300, 128, 60), (1000, 16, 300), (120, 120, 30)] {
        let a = faer::Mat::<f64>::from_fn(m, k, |i, j| (i + 2 * j) as f64 % 7.0);
        let b = faer::Mat::<f64>::from_fn(n, k, |i, j| (i + 3 * j) as f64 % 5.0);
        let mut c = faer::Mat::<f64>::zeros(m, n);
        let times = 1 + 2_000_000_000 / (m * n * k);
        let t = Cpu::now();
        for _ in 0..times {
            matmul(c.as_mut(), Accum::Add, a.as_ref(), b.as_ref().transpose(), -1.0, Par::Seq);
        }
        println!("{m}x{n}x{k}: {:.1} GF/s", 2.0 * (m * n * k * times) as f64 / t.elapsed().as_secs_f64() * 1e-9);
    }
    for n in [30, 60, 128, 512, 1000] {
        let a = faer::Mat::<f64>::from_fn(n, n, |i, j| if i == j { n as f64 } else { 0.5 });
        let mut buffer = MemBuffer::new(dense_llt::cholesky_in_place_scratch::<f64>(n, Par::Seq, Default::default()));
        let times = 1 + 1_000_000_000 / (n * n * n);
        let t = Cpu::now();
        for _ in 0..times {
            let mut c = a.clone();
            dense_llt::cholesky_in_place(c.as_mut(), Default::default(), Par::Seq, MemStack::new(&mut buffer), Default::default()).unwrap();
        }
        println!("chol {n}: {:.1} GF/s", ((n * n * n * times) as f64 / 3.0) / t.elapsed().as_secs_f64() * 1e-9);
        let m = 500;
        let mut b = faer::Mat::<f64>::from_fn(m, n, |i, j| (i + j) as f64 % 3.0);
        let t = Cpu::now();
        for _ in 0..times {
            solve_lower_triangular_in_place(a.as_ref(), b.as_mut().transpose_mut(), Par::Seq);
        }
        println!("trsm {n}x{m}: {:.1} GF/s", (n * n * m * times) as f64 / t.elapsed().as_secs_f64() * 1e-9);
    }
}
