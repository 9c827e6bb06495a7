//! The `pliant` program: mesh, bake, inspect.
//! The pliant program: mesh, bake, inspect.
fn main() {}
