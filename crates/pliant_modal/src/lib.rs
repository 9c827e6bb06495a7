//! Modal soft bodies: the model, its file, the step, grabs, warping and reconstruction.
