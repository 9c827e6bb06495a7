//! Surfaces, signed distance fields and tetrahedra for Pliant: import, export, isosurface stuffing.
