//! From a mesh to a modal model: finite elements, sparse factorisation and vibration modes.
