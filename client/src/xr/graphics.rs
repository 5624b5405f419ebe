//! The Vulkan device that a runtime wants, shared with wgpu, and the session on it.
//!
//! Both `VkInstance` and `VkDevice` are made by the runtime (`XR_KHR_vulkan_enable2`) with what wgpu asks for added to what it needs itself;
//! wgpu then owns and destroys them.

#![allow(unsafe_code)]

use std::ffi::{CStr, c_void};

use ash::vk::{self, Handle};
use openxr as xr;
use wgpu::hal;
use wgpu::hal::api::Vulkan;

use super::Fault;
use super::runtime::Runtime;
use crate::gpu::Gpu;

/// The version of Vulkan that shaders are made for: SPIR-V 1.6 needs it.
const VULKAN: u32 = vk::API_VERSION_1_3;

/// Handles that a session is made from; valid while the GPU's instance and device are.
pub(super) struct Handles {
    instance: *const c_void,
    physical_device: *const c_void,
    device: *const c_void,
    queue_family: u32,
}

/// A session, and the two ends of its frames.
pub(super) type Session = (xr::Session<xr::Vulkan>, xr::FrameWaiter, xr::FrameStream<xr::Vulkan>);

/// Opens the GPU that the headset hangs on.
///
/// # Errors
/// [`Fault::Absent`] where it cannot do Vulkan as needed; those of [`Fault::of`].
pub(super) fn open(runtime: &Runtime) -> Result<(Gpu, Handles), Fault> {
    let absent = |what: &str, error: &dyn std::fmt::Display| Fault::Absent(format!("{what} ({error}); update the GPU's Vulkan driver"));
    let failed = |action| move |code| Fault::of(action, code);
    let requirements = runtime.instance.graphics_requirements::<xr::Vulkan>(runtime.system);
    let least = requirements.map_err(failed("asking which Vulkan the headset needs"))?.min_api_version_supported;
    if (least.major(), least.minor()) > (1, 3) {
        return Err(Fault::Absent(format!(
            "the headset's runtime needs Vulkan {least}, which this program does not speak; update the program"
        )));
    }
    // SAFETY: the system's Vulkan loader, which wgpu loads, too; it stays loaded while anything made from it lives.
    let entry = unsafe { ash::Entry::load() }.map_err(|error| absent("there is no Vulkan loader", &error))?;
    let flags = wgpu::InstanceFlags::empty();
    let extensions =
        hal::vulkan::Instance::desired_extensions(&entry, VULKAN, flags).map_err(|error| absent("Vulkan cannot be used", &error))?;
    // SAFETY: both are the same C function pointer type, declared by two crates.
    let get_instance_proc_addr: xr::sys::platform::VkGetInstanceProcAddr =
        unsafe { std::mem::transmute(entry.static_fn().get_instance_proc_addr) };
    let instance = create_instance(runtime, &extensions, get_instance_proc_addr)?;
    // SAFETY: a live VkInstance that was just made through this entry.
    let raw_instance = unsafe { ash::Instance::load(entry.static_fn(), vk::Instance::from_raw(instance as u64)) };
    // SAFETY: the VkInstance was made by the runtime for this system.
    let physical_device = unsafe { runtime.instance.vulkan_graphics_device(runtime.system, instance) };
    let physical_device = physical_device.map_err(failed("asking which GPU the headset hangs on"))?;
    let physical = vk::PhysicalDevice::from_raw(physical_device as u64);
    // SAFETY: a physical device of this instance.
    let families = unsafe { raw_instance.get_physical_device_queue_family_properties(physical) };
    let wanted = vk::QueueFlags::GRAPHICS | vk::QueueFlags::COMPUTE;
    let queue_family = families.iter().position(|family| family.queue_flags.contains(wanted));
    let queue_family =
        queue_family.ok_or_else(|| Fault::Absent("the headset's GPU has no queue for graphics and compute".to_owned()))? as u32;

    // SAFETY: instance, version and extensions are those that it was made with; without a drop callback wgpu destroys it.
    let hal_instance = unsafe {
        let budget = wgpu::MemoryBudgetThresholds::default();
        hal::vulkan::Instance::from_raw(entry, raw_instance.clone(), VULKAN, 0, None, extensions, flags, budget, false, None)
    };
    let hal_instance = hal_instance.map_err(|error| absent("Vulkan cannot be used", &error))?;
    let exposed = hal_instance.expose_adapter(physical).ok_or_else(|| absent("the headset's GPU cannot be used", &"too old"))?;
    // SAFETY: both come from wgpu-hal's Vulkan backend, and the adapter from this instance.
    let (instance_of_wgpu, adapter) = unsafe {
        let instance = wgpu::Instance::from_hal::<Vulkan>(hal_instance);
        let adapter = instance.create_adapter_from_hal::<Vulkan>(exposed);
        (instance, adapter)
    };
    let maker = DeviceMaker { runtime, get_instance_proc_addr, raw_instance: &raw_instance, physical_device, queue_family };
    let (device, device_of_wgpu, queue) = maker.open(&adapter)?;
    let handles = Handles { instance, physical_device, device, queue_family };
    Ok((Gpu::from_parts(instance_of_wgpu, adapter, device_of_wgpu, queue), handles))
}

fn create_instance(
    runtime: &Runtime,
    extensions: &[&'static CStr],
    get_instance_proc_addr: xr::sys::platform::VkGetInstanceProcAddr,
) -> Result<*const c_void, Fault> {
    let names: Vec<_> = extensions.iter().map(|name| name.as_ptr()).collect();
    let application = vk::ApplicationInfo::default().application_name(c"MR360 live").api_version(VULKAN);
    let info = vk::InstanceCreateInfo::default().application_info(&application).enabled_extension_names(&names);
    // SAFETY: the requirements were asked for before; `info` and all it points to live until the call returns.
    let made = unsafe { runtime.instance.create_vulkan_instance(runtime.system, get_instance_proc_addr, (&raw const info).cast()) };
    refused(made.map_err(|code| Fault::of("making a Vulkan instance for the headset", code))?)
}

/// What Vulkan itself says.
fn refused(made: Result<*const c_void, xr::sys::platform::VkResult>) -> Result<*const c_void, Fault> {
    made.map_err(|code| {
        Fault::Absent(format!("Vulkan refuses what the headset needs ({}); update the GPU's driver", vk::Result::from_raw(code)))
    })
}

struct DeviceMaker<'a> {
    runtime: &'a Runtime,
    get_instance_proc_addr: xr::sys::platform::VkGetInstanceProcAddr,
    raw_instance: &'a ash::Instance,
    physical_device: *const c_void,
    queue_family: u32,
}

impl DeviceMaker<'_> {
    /// The `VkDevice`, and what wgpu makes of it.
    fn open(&self, adapter: &wgpu::Adapter) -> Result<(*const c_void, wgpu::Device, wgpu::Queue), Fault> {
        let absent =
            |error: &dyn std::fmt::Display| Fault::Absent(format!("the headset's GPU gives no device ({error}); update its driver"));
        let (features, limits) = (Gpu::features(adapter), Gpu::limits(adapter));
        let memory_hints = wgpu::MemoryHints::Performance;
        let (device, opened) = {
            // SAFETY: the guard is dropped before the adapter is used elsewhere.
            let hal_adapter = unsafe { adapter.as_hal::<Vulkan>() }.ok_or_else(|| absent(&"not Vulkan"))?;
            let extensions = hal_adapter.required_device_extensions(features);
            let device = self.create_device(&hal_adapter, &extensions, features)?;
            // SAFETY: a live VkDevice that was just made from this physical device.
            let raw = unsafe { ash::Device::load(self.raw_instance.fp_v1_0(), vk::Device::from_raw(device as u64)) };
            // SAFETY: made from this adapter, with the queue family, extensions and features given here; without a drop callback wgpu destroys it.
            let opened =
                unsafe { hal_adapter.device_from_raw(raw, None, &extensions, features, &limits, &memory_hints, self.queue_family, 0) };
            (device, opened.map_err(|error| absent(&error))?)
        };
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("mr360 headset"),
            required_features: features,
            required_limits: limits,
            memory_hints,
            ..wgpu::DeviceDescriptor::default()
        };
        // SAFETY: opened from this adapter with the same features and limits.
        let (device_of_wgpu, queue) =
            unsafe { adapter.create_device_from_hal::<Vulkan>(opened, &descriptor) }.map_err(|error| absent(&error))?;
        Ok((device, device_of_wgpu, queue))
    }

    fn create_device(
        &self,
        adapter: &hal::vulkan::Adapter,
        extensions: &[&'static CStr],
        features: wgpu::Features,
    ) -> Result<*const c_void, Fault> {
        let mut enabled = adapter.physical_device_features(extensions, features);
        let priorities = [1.0];
        let queues = [vk::DeviceQueueCreateInfo::default().queue_family_index(self.queue_family).queue_priorities(&priorities)];
        let names: Vec<_> = extensions.iter().map(|name| name.as_ptr()).collect();
        let info = vk::DeviceCreateInfo::default().queue_create_infos(&queues).enabled_extension_names(&names);
        let info = enabled.add_to_device_create(info);
        let Self { runtime, get_instance_proc_addr, physical_device, .. } = *self;
        // SAFETY: the physical device is the one that the runtime named; `info` and all it points to live until the call returns.
        let made = unsafe {
            runtime.instance.create_vulkan_device(runtime.system, get_instance_proc_addr, physical_device, (&raw const info).cast())
        };
        refused(made.map_err(|code| Fault::of("making a Vulkan device for the headset", code))?)
    }
}

/// Begins a session on the GPU, which is kept until the session is gone. Its queue must be used by the thread that uses the session, and no
/// other.
///
/// # Errors
/// Those of [`Fault::of`].
pub(super) fn begin_session(runtime: &Runtime, gpu: &Gpu, handles: &Handles) -> Result<Session, Fault> {
    let info = xr::vulkan::SessionCreateInfo {
        instance: handles.instance,
        physical_device: handles.physical_device,
        device: handles.device,
        queue_family_index: handles.queue_family,
        queue_index: 0,
    };
    let guard = Box::new((gpu.device.clone(), gpu.queue.clone(), gpu.adapter.clone(), gpu.instance.clone()));
    // SAFETY: the handles are those of the GPU, which the guard keeps alive. The frame loop submits and calls the session on one thread.
    let session = unsafe { runtime.instance.create_session_with_guard::<xr::Vulkan>(runtime.system, &info, guard) };
    session.map_err(|code| Fault::of("beginning a session with the headset", code))
}
