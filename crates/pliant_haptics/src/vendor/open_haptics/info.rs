//! The properties of a device, assumed and as the library gives them.

use std::ffi::c_uint;

use super::{
    DEVICE_MODEL_TYPE, DEVICE_SERIAL_NUMBER, NOMINAL_MAX_CONTINUOUS_FORCE, NOMINAL_MAX_DAMPING,
    NOMINAL_MAX_FORCE, NOMINAL_MAX_STIFFNESS, OpenHapticsApi, OpenHapticsConfig, USABLE_WORKSPACE_DIMENSIONS,
};
use crate::{DeviceInfo, vendor::text};

/// Returns the assumed properties before the device was queried.
pub(super) fn describe(config: &OpenHapticsConfig) -> DeviceInfo {
    DeviceInfo {
        name: "3D Systems device".into(),
        serial: String::new(),
        peak_force: 3.3,
        continuous_force: 0.88,
        peak_torque: 0.0,
        force_axes: [true; 3],
        torque_axes: [false; 3],
        max_stiffness: 400.0,
        max_damping: 4.0,
        damping: 0.2,
        friction: 0.2,
        mass: 0.045,
        resolution: 55e-6,
        // The force that answers a measurement goes out with the next servo tick.
        delay: 1.0 / config.rate,
        workspace: [[-0.08, -0.06, -0.035], [0.08, 0.06, 0.035]],
        buttons: 4,
        simulated: false,
    }
}

/// Reads the properties of the current device. Values that are not usable keep the assumed ones.
///
/// # Safety
/// A device is current, and `api` is that of a loaded library.
pub(super) unsafe fn read_info(api: &OpenHapticsApi, config: &OpenHapticsConfig) -> DeviceInfo {
    let mut info = describe(config);
    let double = |what: c_uint, scale: f64, or: f64| {
        let mut value = [0.0f64; 16];
        // SAFETY: no parameter of HDAPI has more than 16 doubles.
        let error = unsafe {
            (api.get_double)(what, value.as_mut_ptr());
            api.drain()
        };
        let value = value[0] * scale;
        if error.code == 0 && value.is_finite() && value > 0.0 { value } else { or }
    };
    // The library gives the stiffness in N/mm and the damping in N s/mm.
    info.max_stiffness = double(NOMINAL_MAX_STIFFNESS, 1e3, info.max_stiffness);
    info.max_damping = double(NOMINAL_MAX_DAMPING, 1e3, info.max_damping);
    info.peak_force = double(NOMINAL_MAX_FORCE, 1.0, info.peak_force);
    info.continuous_force =
        double(NOMINAL_MAX_CONTINUOUS_FORCE, 1.0, info.continuous_force).min(info.peak_force);
    let mut box_mm = [0.0f64; 16];
    // SAFETY: the library writes six doubles, smallest corner first. It owns the strings.
    unsafe {
        (api.get_double)(USABLE_WORKSPACE_DIMENSIONS, box_mm.as_mut_ptr());
        let error = api.drain();
        let [a, b, c, d, e, f, ..] = box_mm.map(|x| 1e-3 * x);
        if error.code == 0
            && [a, b, c].into_iter().zip([d, e, f]).all(|(l, h)| l.is_finite() && h.is_finite() && l < h)
        {
            info.workspace = [[a, b, c], [d, e, f]];
        }
        let name = text((api.get_string)(DEVICE_MODEL_TYPE));
        if !name.is_empty() {
            info.name = name;
        }
        info.serial = text((api.get_string)(DEVICE_SERIAL_NUMBER));
        let _ = api.drain();
    }
    info
}
