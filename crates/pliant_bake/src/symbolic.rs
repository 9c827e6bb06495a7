//! Symbolic Cholesky factorization on the graph of nodes: elimination tree, supernodes and
//! independent subtrees.
//!
//! Each node has three degrees of freedom. All counts in this module are nodes, and the numeric
//! part multiplies them by three.

use crate::fem::Lists;

/// Marks a node or supernode without a parent.
pub(crate) const ROOT: usize = usize::MAX;

/// Largest number of nodes of an elimination subtree that becomes one dense supernode.
const RELAXED_SUBTREE: usize = 8;

/// Limits for merging a child with its parent: at most (.0) columns in the merged supernode and at
/// most the fraction (.1) of stored zeros.
const MERGE: [(usize, f64); 4] = [(4, 1.0), (12, 0.5), (32, 0.15), (usize::MAX, 0.05)];

/// Columns with a common sparsity pattern, factored as a dense block.
#[derive(Clone, Debug)]
pub(crate) struct Supernode {
    /// First node.
    pub(crate) first: usize,
    /// Number of nodes that this supernode eliminates: `first..first + columns`.
    pub(crate) columns: usize,
    /// Coupled nodes below the supernode, in ascending order.
    pub(crate) rows: Vec<u32>,
    pub(crate) parent: usize,
    pub(crate) children: Vec<usize>,
    /// Start of the supernode's values. They are column-major, `3 (columns + rows)` by `3 columns`.
    pub(crate) at: usize,
    /// Number of rows inside the task's own subtree (all rows for supernodes of the top).
    pub(crate) inside: usize,
    /// Positions of the rows past `inside` in the rows of the task's root.
    pub(crate) outside: Vec<u32>,
}

impl Supernode {
    /// Returns the number of eliminated degrees of freedom.
    pub(crate) fn width(&self) -> usize {
        3 * self.columns
    }

    /// Returns the number of coupled degrees of freedom below.
    pub(crate) fn below(&self) -> usize {
        3 * self.rows.len()
    }

    /// Returns the number of stored values.
    pub(crate) fn values(&self) -> usize {
        (self.width() + self.below()) * self.width()
    }

    /// Estimates the multiplications of the dense factorization.
    fn cost(&self) -> f64 {
        let (w, b) = (self.width() as f64, self.below() as f64);
        w * w * w / 3.0 + w * w * b + w * b * b
    }
}

/// Supernodes in elimination order, divided into independent subtrees and the top that joins them.
#[derive(Clone, Debug)]
pub(crate) struct Symbolic {
    pub(crate) supernodes: Vec<Supernode>,
    /// Ranges of supernodes that form independent subtrees, in order and without overlap.
    pub(crate) tasks: Vec<std::ops::Range<usize>>,
    /// All other supernodes, in ascending order.
    pub(crate) top: Vec<usize>,
    /// Number of values of the whole factor.
    pub(crate) values: usize,
}

/// Returns the parents in the elimination tree (Liu 1990), `ROOT` at the top. `graph` is in
/// elimination order.
fn elimination_tree(graph: &Lists) -> Vec<usize> {
    let n = graph.len();
    let (mut parent, mut ancestor) = (vec![ROOT; n], vec![ROOT; n]);
    for j in 0..n {
        for &i in graph.of(j).iter().take_while(|&&i| (i as usize) < j) {
            let mut at = i as usize;
            while ancestor[at] != ROOT && ancestor[at] != j {
                at = std::mem::replace(&mut ancestor[at], j);
            }
            if ancestor[at] == ROOT {
                ancestor[at] = j;
                parent[at] = j;
            }
        }
    }
    parent
}

/// Returns a postorder of the elimination tree: position to node. Subtrees become contiguous, and
/// the largest child comes last.
pub(crate) fn postorder(graph: &Lists) -> Vec<u32> {
    let parent = elimination_tree(graph);
    let n = parent.len();
    let mut size = vec![1usize; n];
    let mut children: Vec<Vec<u32>> = vec![Vec::new(); n];
    let mut roots = Vec::new();
    for j in 0..n {
        if parent[j] == ROOT {
            roots.push(j as u32);
        } else {
            size[parent[j]] += size[j];
            children[parent[j]].push(j as u32);
        }
    }
    let mut order = Vec::with_capacity(n);
    // The loop makes a preorder with the parent first and the largest child next, and the result is
    // reversed.
    let mut stack = roots;
    while let Some(j) = stack.pop() {
        order.push(j);
        let list = &mut children[j as usize];
        list.sort_by_key(|&c| size[c as usize]);
        stack.append(list);
    }
    order.reverse();
    order
}

impl Symbolic {
    /// Makes the symbolic factorization. `graph` must be in a postordered elimination order.
    pub(crate) fn new(graph: &Lists) -> Self {
        let parent = elimination_tree(graph);
        let patterns = column_patterns(graph, &parent);
        let mut starts = partition(&parent, &patterns);
        let n = graph.len();
        let count = starts.len();
        starts.push(n);
        let mut of_node = vec![0usize; n];
        let mut supernodes = Vec::with_capacity(count);
        let mut values = 0;
        for s in 0..count {
            let (first, end) = (starts[s], starts[s + 1]);
            of_node[first..end].fill(s);
            let mut supernode = Supernode {
                first,
                columns: end - first,
                rows: patterns.of(end - 1).to_vec(),
                parent: ROOT,
                children: Vec::new(),
                at: values,
                inside: 0,
                outside: Vec::new(),
            };
            supernode.inside = supernode.rows.len();
            values += supernode.values();
            supernodes.push(supernode);
        }
        for s in 0..count {
            if let Some(&row) = supernodes[s].rows.first() {
                let up = of_node[row as usize];
                supernodes[s].parent = up;
                supernodes[up].children.push(s);
            }
        }
        let mut out = Self { supernodes, tasks: Vec::new(), top: Vec::new(), values };
        out.cut();
        out
    }

    /// Selects the tasks: subtrees with at most about a sixteenth of the work.
    fn cut(&mut self) {
        let count = self.supernodes.len();
        let mut work: Vec<f64> = self.supernodes.iter().map(Supernode::cost).collect();
        let mut size = vec![1usize; count];
        for s in 0..count {
            let up = self.supernodes[s].parent;
            if up != ROOT {
                work[up] += work[s];
                size[up] += size[s];
            }
        }
        let limit =
            work.iter().zip(&self.supernodes).filter(|(_, s)| s.parent == ROOT).map(|(w, _)| w).sum::<f64>()
                / 16.0;
        for s in 0..count {
            let up = self.supernodes[s].parent;
            if work[s] > limit {
                self.top.push(s);
            } else if up == ROOT || work[up] > limit {
                self.tasks.push(s + 1 - size[s]..s + 1);
            }
        }
        for task in &self.tasks {
            let root = task.end - 1;
            let end = (self.supernodes[root].first + self.supernodes[root].columns) as u32;
            let root_rows = self.supernodes[root].rows.clone();
            for supernode in &mut self.supernodes[task.clone()] {
                supernode.inside = supernode.rows.partition_point(|&row| row < end);
                supernode.outside = supernode.rows[supernode.inside..]
                    .iter()
                    .map(|row| root_rows.partition_point(|r| r < row) as u32)
                    .collect();
            }
        }
    }
}

/// Returns the pattern below the diagonal of each column of the factor, in ascending order.
fn column_patterns(graph: &Lists, parent: &[usize]) -> Lists {
    let n = graph.len();
    let mut out = Lists { offsets: vec![0], items: Vec::new() };
    let mut mark = vec![ROOT; n];
    let mut first_child = vec![ROOT; n];
    let mut next_sibling = vec![ROOT; n];
    for j in 0..n {
        let start = out.items.len();
        mark[j] = j;
        for &i in graph.of(j) {
            if i as usize > j {
                mark[i as usize] = j;
                out.items.push(i);
            }
        }
        let mut child = first_child[j];
        while child != ROOT {
            for at in out.offsets[child]..out.offsets[child + 1] {
                let i = out.items[at];
                if mark[i as usize] != j {
                    mark[i as usize] = j;
                    out.items.push(i);
                }
            }
            child = next_sibling[child];
        }
        out.items[start..].sort_unstable();
        out.offsets.push(out.items.len());
        if parent[j] != ROOT {
            next_sibling[j] = first_child[parent[j]];
            first_child[parent[j]] = j;
        }
    }
    out
}

/// Returns the first columns of the supernodes.
fn partition(parent: &[usize], patterns: &Lists) -> Vec<usize> {
    let n = parent.len();
    let mut size = vec![1usize; n];
    for j in 0..n {
        if parent[j] != ROOT {
            size[parent[j]] += size[j];
        }
    }
    // Each entry holds (first column, stored values of the nodes' pattern). The last column is one
    // before the first column of the next entry.
    let mut stack: Vec<(usize, f64)> = Vec::new();
    let length = |j: usize| patterns.of(j).len();
    let stored = |first: usize, last: usize| {
        let columns = (last + 1 - first) as f64;
        columns * (columns + 1.0) / 2.0 + columns * length(last) as f64
    };
    let mut j = 0;
    let mut relaxed_end = vec![0usize; n];
    // This is the end of the largest relaxed subtree that starts at each column.
    for root in 0..n {
        if size[root] <= RELAXED_SUBTREE {
            relaxed_end[root + 1 - size[root]] = root + 1;
        }
    }
    while j < n {
        let first = j;
        let mut last = j;
        if relaxed_end[j] > 0 {
            last = relaxed_end[j] - 1;
        } else {
            while last + 1 < n
                && parent[last] == last + 1
                && length(last + 1) + 1 == length(last)
                && size[last + 1] == size[last] + 1
            {
                last += 1;
            }
        }
        j = last + 1;
        let exact: f64 = (first..=last).map(|c| 1.0 + length(c) as f64).sum();
        let mut current = (first, exact);
        while let Some(&(child, child_exact)) = stack.last() {
            let child_last = current.0 - 1;
            if parent[child_last] > last || parent[child_last] < current.0 {
                break;
            }
            let columns = last + 1 - child;
            let total = stored(child, last);
            let zeros = 1.0 - (child_exact + current.1) / total;
            if !MERGE.iter().any(|&(most, share)| columns <= most && zeros <= share) {
                break;
            }
            current = (child, child_exact + current.1);
            stack.pop();
        }
        stack.push(current);
    }
    stack.into_iter().map(|(first, _)| first).collect()
}
