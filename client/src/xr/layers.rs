//! What a frame hands to the runtime's compositor.

#![allow(unsafe_code)]

use openxr as xr;

use super::swapchain::Swapchain;
use crate::camera::Camera;

/// Ends a frame with both eyes' pictures, drawn from `views` located in `space`, and their depth where there is one, with so many of its metres
/// to one of the viewer's.
///
/// # Errors
/// The runtime's.
pub(super) fn end(
    stream: &mut xr::FrameStream<xr::Vulkan>,
    (time, blend): (xr::Time, xr::EnvironmentBlendMode),
    (space, views): (&xr::Space, &[xr::View]),
    colour: &Swapchain,
    depth: Option<(&Swapchain, f32)>,
) -> Result<(), xr::sys::Result> {
    let depths: Vec<_> = depth.map_or_else(Vec::new, |depth| (0..views.len() as u32).map(|layer| depth_info(depth, layer)).collect());
    let projected: Vec<_> = views
        .iter()
        .zip(0..)
        .map(|(view, layer)| {
            let built = xr::CompositionLayerProjectionView::new().pose(view.pose).fov(view.fov).sub_image(sub_image(colour, layer));
            match depths.get(layer as usize) {
                Some(depth) => chained(built, depth),
                None => built,
            }
        })
        .collect();
    stream.end(time, blend, &[&xr::CompositionLayerProjection::new().space(space).views(&projected)])
}

fn sub_image(swapchain: &Swapchain, layer: u32) -> xr::SwapchainSubImage<'_, xr::Vulkan> {
    let extent = xr::Extent2Di { width: swapchain.size.0 as i32, height: swapchain.size.1 as i32 };
    let image_rect = xr::Rect2Di { offset: xr::Offset2Di { x: 0, y: 0 }, extent };
    xr::SwapchainSubImage::new().swapchain(&swapchain.handle).image_array_index(layer).image_rect(image_rect)
}

/// Depth as the camera's projection makes it: reversed and without a far plane.
fn depth_info((depth, scale): (&Swapchain, f32), layer: u32) -> xr::sys::CompositionLayerDepthInfoKHR {
    xr::sys::CompositionLayerDepthInfoKHR {
        ty: xr::sys::CompositionLayerDepthInfoKHR::TYPE,
        next: std::ptr::null(),
        sub_image: sub_image(depth, layer).into_raw(),
        min_depth: 0.0,
        max_depth: 1.0,
        near_z: f32::INFINITY,
        far_z: Camera::NEAR_M / scale,
    }
}

fn chained<'a>(
    view: xr::CompositionLayerProjectionView<'a, xr::Vulkan>,
    depth: &'a xr::sys::CompositionLayerDepthInfoKHR,
) -> xr::CompositionLayerProjectionView<'a, xr::Vulkan> {
    let raw = xr::sys::CompositionLayerProjectionView { next: std::ptr::from_ref(depth).cast(), ..view.into_raw() };
    // SAFETY: the view as it was built, with the depth, which lives as long, chained to it.
    unsafe { xr::CompositionLayerProjectionView::from_raw(raw) }
}
