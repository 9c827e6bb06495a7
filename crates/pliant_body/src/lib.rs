//! Bevy plugin for modal soft bodies: components, assets, fixed-step systems, pointer grabs, deformation.
