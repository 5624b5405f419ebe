//! Pictures that the runtime lends: one array of two layers, left and right.

#![allow(unsafe_code)]

use ash::vk::{self, Handle};
use openxr as xr;
use wgpu::hal;
use wgpu::hal::api::Vulkan;

use super::Fault;
use crate::gpu::Gpu;

/// Longest that the runtime may keep a picture that it has lent already, nanoseconds.
const PATIENCE_NS: i64 = 1_000_000_000;

/// What the pictures hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Content {
    Colour,
    Depth,
}

impl Content {
    /// Formats by preference, as Vulkan and as wgpu name them. Colour is written linear: either the attachment encodes it, or it is stored as
    /// it is; the runtime takes codes of formats without sRGB for linear, so that those of 8 bits are none of ours.
    const fn formats(self) -> &'static [(vk::Format, wgpu::TextureFormat)] {
        match self {
            Self::Colour => &[
                (vk::Format::R8G8B8A8_SRGB, wgpu::TextureFormat::Rgba8UnormSrgb),
                (vk::Format::B8G8R8A8_SRGB, wgpu::TextureFormat::Bgra8UnormSrgb),
                (vk::Format::R16G16B16A16_SFLOAT, wgpu::TextureFormat::Rgba16Float),
            ],
            Self::Depth => &[(vk::Format::D32_SFLOAT, crate::view::DEPTH_FORMAT)],
        }
    }

    fn usage(self) -> xr::SwapchainUsageFlags {
        let attached = match self {
            Self::Colour => xr::SwapchainUsageFlags::COLOR_ATTACHMENT | xr::SwapchainUsageFlags::TRANSFER_SRC,
            Self::Depth => xr::SwapchainUsageFlags::DEPTH_STENCIL_ATTACHMENT,
        };
        attached | xr::SwapchainUsageFlags::SAMPLED
    }

    /// The state in which the runtime lends and wants back its pictures.
    const fn state(self) -> wgpu::TextureUses {
        match self {
            Self::Colour => wgpu::TextureUses::COLOR_TARGET,
            Self::Depth => wgpu::TextureUses::DEPTH_STENCIL_WRITE,
        }
    }

    fn texture_usage(self) -> (wgpu::TextureUsages, wgpu::TextureUses) {
        match self {
            Self::Colour => {
                (wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::COPY_SRC, self.state() | wgpu::TextureUses::COPY_SRC)
            }
            Self::Depth => (wgpu::TextureUsages::RENDER_ATTACHMENT, self.state() | wgpu::TextureUses::DEPTH_STENCIL_READ),
        }
    }
}

/// The format of a session's pictures of some content, if it offers one that is drawn here.
pub(super) fn format(session: &xr::Session<xr::Vulkan>, content: Content) -> Result<Option<(vk::Format, wgpu::TextureFormat)>, Fault> {
    let offered = session.enumerate_swapchain_formats().map_err(|code| Fault::of("asking for the headset's formats", code))?;
    let is_offered = |format: &vk::Format| u32::try_from(format.as_raw()).is_ok_and(|format| offered.contains(&format));
    Ok(content.formats().iter().copied().find(|(format, _)| is_offered(format)))
}

/// How far the lending of a picture is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Lent {
    No,
    /// Named, but perhaps still read by the runtime.
    Acquired(usize),
    /// Ours to draw to.
    Held(usize),
}

/// Views of a picture for both eyes.
pub(super) struct EyeViews {
    /// Of each eye's layer.
    pub(super) each: [wgpu::TextureView; 2],
    /// Of both layers.
    pub(super) both: wgpu::TextureView,
}

/// Pictures for both eyes.
pub(super) struct Swapchain {
    // The textures go before what lends them.
    views: Vec<EyeViews>,
    textures: Vec<wgpu::Texture>,
    pub(super) handle: xr::Swapchain<xr::Vulkan>,
    pub(super) format: wgpu::TextureFormat,
    pub(super) size: (u32, u32),
    lent: Lent,
    device: wgpu::Device,
}

impl Swapchain {
    /// Pictures of a format that [`format()`] gave.
    ///
    /// # Errors
    /// Those of [`Fault::of`].
    pub(super) fn new(
        session: &xr::Session<xr::Vulkan>,
        gpu: &Gpu,
        content: Content,
        (raw_format, format): (vk::Format, wgpu::TextureFormat),
        (width, height): (u32, u32),
    ) -> Result<Self, Fault> {
        let failed = |code| Fault::of("making the headset's pictures", code);
        let handle = session
            .create_swapchain(&xr::SwapchainCreateInfo {
                create_flags: xr::SwapchainCreateFlags::EMPTY,
                usage_flags: content.usage(),
                format: raw_format.as_raw() as u32,
                sample_count: 1,
                width,
                height,
                face_count: 1,
                array_size: 2,
                mip_count: 1,
            })
            .map_err(failed)?;
        let size = wgpu::Extent3d { width, height, depth_or_array_layers: 2 };
        let images = handle.enumerate_images().map_err(failed)?;
        let textures: Option<Vec<_>> = images.into_iter().map(|image| wrap(gpu, image, content, format, size)).collect();
        let textures = textures.ok_or_else(|| Fault::Failed("the headset's pictures are not Vulkan's".to_owned()))?;
        let layer = |texture: &wgpu::Texture, base_array_layer| {
            let dimension = Some(wgpu::TextureViewDimension::D2);
            texture.create_view(&wgpu::TextureViewDescriptor {
                dimension,
                base_array_layer,
                array_layer_count: Some(1),
                ..Default::default()
            })
        };
        let views = textures.iter().map(|texture| EyeViews {
            each: [layer(texture, 0), layer(texture, 1)],
            both: texture.create_view(&wgpu::TextureViewDescriptor::default()),
        });
        let views = views.collect();
        Ok(Self { views, textures, handle, format, size: (width, height), lent: Lent::No, device: gpu.device.clone() })
    }

    /// Borrows the next picture. True when the runtime was still reading it, so that this thread stood still; `None` when it did not give it
    /// in time: then ask again.
    ///
    /// # Errors
    /// The runtime's.
    pub(super) fn acquire(&mut self) -> Result<Option<bool>, xr::sys::Result> {
        let at = match self.lent {
            Lent::Held(_) => return Ok(Some(false)),
            Lent::Acquired(at) => at,
            Lent::No => self.handle.acquire_image()? as usize,
        };
        self.lent = Lent::Acquired(at);
        let mut stood_still = false;
        for timeout in [xr::Duration::NONE, xr::Duration::from_nanos(PATIENCE_NS)] {
            if self.wait(timeout)? {
                self.lent = Lent::Held(at);
                return Ok(Some(stood_still));
            }
            stood_still = true;
        }
        Ok(None)
    }

    /// True when the picture is ours. The safe wrapper does not tell a timeout from success.
    fn wait(&self, timeout: xr::Duration) -> Result<bool, xr::sys::Result> {
        let info = xr::sys::SwapchainImageWaitInfo { ty: xr::sys::SwapchainImageWaitInfo::TYPE, next: std::ptr::null(), timeout };
        // SAFETY: the swapchain lives, one of its pictures is acquired and not waited for, and `info` lives until the call returns.
        let code = unsafe { (self.handle.instance().fp().wait_swapchain_image)(self.handle.as_raw(), &raw const info) };
        match code {
            xr::sys::Result::TIMEOUT_EXPIRED => Ok(false),
            code if code.into_raw() >= 0 => Ok(true),
            code => Err(code),
        }
    }

    /// The borrowed picture, and views of it.
    pub(super) fn held(&self) -> Option<(&wgpu::Texture, &EyeViews)> {
        let Lent::Held(at) = self.lent else { return None };
        self.textures.get(at).zip(self.views.get(at))
    }

    /// Gives the picture back. Everything that is to be in it has been submitted.
    ///
    /// # Errors
    /// The runtime's.
    pub(super) fn release(&mut self) -> Result<(), xr::sys::Result> {
        if !matches!(self.lent, Lent::Held(_)) {
            return Ok(());
        }
        self.lent = Lent::No;
        // SAFETY: the swapchain lives, and its oldest acquired picture was waited for. The safe wrapper knows of its own waits only.
        let code = unsafe { (self.handle.instance().fp().release_swapchain_image)(self.handle.as_raw(), std::ptr::null()) };
        if code.into_raw() >= 0 { Ok(()) } else { Err(code) }
    }
}

impl Drop for Swapchain {
    fn drop(&mut self) {
        // The runtime frees the pictures: nothing may draw to them any more. A lost device draws nothing.
        let _ = self.device.poll(wgpu::PollType::Wait { submission_index: None, timeout: Some(std::time::Duration::from_secs(5)) });
    }
}

/// The runtime's image as a texture that does not own it.
fn wrap(gpu: &Gpu, image: u64, content: Content, format: wgpu::TextureFormat, size: wgpu::Extent3d) -> Option<wgpu::Texture> {
    let (usage, uses) = content.texture_usage();
    let hal_descriptor = hal::TextureDescriptor {
        label: None,
        size,
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format,
        usage: uses,
        memory_flags: hal::MemoryFlags::empty(),
        view_formats: vec![],
    };
    let descriptor = wgpu::TextureDescriptor {
        label: Some("headset"),
        size,
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format,
        usage,
        view_formats: &[],
    };
    // SAFETY: the image is of this device and was made as the descriptors say; with a drop callback wgpu does not destroy it, and the
    // swapchain that owns it outlives the texture. The runtime lends it in the state given here.
    unsafe {
        let device = gpu.device.as_hal::<Vulkan>()?;
        let memory = hal::vulkan::TextureMemory::External;
        let texture = device.texture_from_raw(vk::Image::from_raw(image), &hal_descriptor, Some(Box::new(|| {})), memory);
        drop(device);
        Some(gpu.device.create_texture_from_hal::<Vulkan>(texture, &descriptor, content.state()))
    }
}
