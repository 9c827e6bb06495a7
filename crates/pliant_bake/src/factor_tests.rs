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
