//! The runtime: its loader, an instance, the headset it knows of.

use openxr as xr;

use super::Fault;

/// Of the headset's two views.
pub(super) const VIEWS: xr::ViewConfigurationType = xr::ViewConfigurationType::PRIMARY_STEREO;

/// The OpenXR loader, which finds the runtime that the user chose.
pub(super) struct Loader(xr::Entry);

impl Loader {
    /// Loads it from the system.
    ///
    /// # Errors
    /// [`Fault::Absent`] where none is installed.
    #[allow(unsafe_code)]
    pub(super) fn load() -> Result<Self, Fault> {
        // SAFETY: a library of that name on the loader's path is Khronos' OpenXR loader, as any program that uses OpenXR has to assume.
        let entry = unsafe { xr::Entry::load(&()) };
        let fault =
            |error| format!("there is no OpenXR loader ({error}); install the headset's runtime, and libopenxr-loader1 or its like");
        entry.map(Self).map_err(|error| Fault::Absent(fault(error)))
    }
}

/// A connection to the runtime, and the headset that it found.
pub(super) struct Runtime {
    pub(super) instance: xr::Instance,
    pub(super) system: xr::SystemId,
    /// How layers meet what is behind the display.
    pub(super) blend: xr::EnvironmentBlendMode,
    /// Columns and rows of one eye's picture.
    pub(super) eye_size: (u32, u32),
    /// What it can do beyond the least.
    pub(super) extensions: xr::ExtensionSet,
}

impl Runtime {
    /// Connects, and asks for a headset.
    ///
    /// # Errors
    /// [`Fault::Absent`] where no runtime is installed or it cannot do what is needed, [`Fault::Later`] where it may yet: its service or the
    /// headset is not there.
    pub(super) fn open(loader: &Loader) -> Result<Self, Fault> {
        let failed = |action| move |result| Fault::of(action, result);
        let offered = loader.0.enumerate_extensions().map_err(failed("asking the OpenXR runtime for its extensions"))?;
        if !offered.khr_vulkan_enable2 {
            return Err(Fault::Absent("the OpenXR runtime cannot be used with Vulkan (XR_KHR_vulkan_enable2); update it".to_owned()));
        }
        let mut extensions = xr::ExtensionSet::default();
        extensions.khr_vulkan_enable2 = true;
        extensions.khr_composition_layer_depth = offered.khr_composition_layer_depth;
        extensions.ext_local_floor = offered.ext_local_floor;
        extensions.khr_convert_timespec_time = offered.khr_convert_timespec_time;
        let application = xr::ApplicationInfo {
            application_name: "MR360 live",
            application_version: 1,
            engine_name: "MR360 live",
            engine_version: 1,
            api_version: xr::Version::new(1, 0, 0),
        };
        let instance = loader.0.create_instance(&application, &extensions, &[], &()).map_err(failed("connecting to the OpenXR runtime"))?;
        let properties = instance.properties().map_err(failed("asking the OpenXR runtime who it is"))?;
        let name = format!("{} {}", properties.runtime_name, properties.runtime_version);
        let system = instance.system(xr::FormFactor::HEAD_MOUNTED_DISPLAY).map_err(failed("asking for a headset"))?;
        let kinds = instance.enumerate_view_configurations(system).map_err(failed("asking for the headset's views"))?;
        let blends = instance.enumerate_environment_blend_modes(system, VIEWS).map_err(failed("asking for the headset's display"))?;
        let views = instance.enumerate_view_configuration_views(system, VIEWS).map_err(failed("asking for the headset's views"))?;
        let opaque = blends.iter().find(|mode| **mode == xr::EnvironmentBlendMode::OPAQUE).or(blends.first()).copied();
        let (true, 2, Some(blend)) = (kinds.contains(&VIEWS), views.len(), opaque) else {
            return Err(Fault::Absent(format!("the device of {name} does not show a view to each eye")));
        };
        // Both eyes share an array of pictures.
        let wanted = |of: fn(&xr::ViewConfigurationView) -> (u32, u32)| {
            let (recommended, most): (Vec<u32>, Vec<u32>) = views.iter().map(of).unzip();
            recommended.into_iter().max().unwrap_or(1).min(most.into_iter().min().unwrap_or(1)).max(1)
        };
        let width = wanted(|view| (view.recommended_image_rect_width, view.max_image_rect_width));
        let height = wanted(|view| (view.recommended_image_rect_height, view.max_image_rect_height));
        let device = instance.system_properties(system).map_err(failed("asking the headset who it is"))?.system_name;
        tracing::info!(runtime = name, headset = device, "headset found, {width}×{height} pixels an eye");
        Ok(Self { instance, system, blend, eye_size: (width, height), extensions })
    }

    /// The runtime's clock, or `None` where it cannot be read.
    pub(super) fn now(&self) -> Option<xr::Time> {
        if !self.extensions.khr_convert_timespec_time {
            return None;
        }
        self.instance.now().ok()
    }
}
