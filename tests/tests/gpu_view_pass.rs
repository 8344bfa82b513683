//! Does the view pass paint into somebody else's target what the Rust twins cast? On any adapter, lavapipe too; the
//! tolerance is that of `isinglass_tests::twins`.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::kernels::layering;
use isinglass_core::kernels::march::MarchSettings;
use isinglass_core::kernels::{combine, raycast};
use isinglass_core::layer::FrameHeader;
use isinglass_core::mode::Mode;
use isinglass_core::picture::Picture;
use isinglass_gpu::{Gpu, ViewPass, wgpu};
use isinglass_tests::twins::{BACKGROUND, Difference, camera, gpu, header, scenes, views};

/// Twice as large each way, linear between the centres of pixels.
fn enlarged(picture: &Picture) -> Picture {
    let mut large = Picture::new(2 * picture.width, 2 * picture.height);
    // Left or upper neighbour, the other one, and the share of the other.
    let between = |x: u32, side: u32| {
        let at = (x as f32 * 0.5 - 0.25).clamp(0.0, side as f32 - 1.0);
        (at as u32, (at as u32 + 1).min(side - 1), at.fract())
    };
    for (i, pixel) in large.pixels.iter_mut().enumerate() {
        let (x0, x1, right) = between(i as u32 % large.width, picture.width);
        let (y0, y1, below) = between(i as u32 / large.width, picture.height);
        let at = |x: u32, y: u32| glam::Vec4::from(picture.pixels[(y * picture.width + x) as usize]);
        let row = |y| at(x0, y).lerp(at(x1, y), right);
        *pixel = row(y0).lerp(row(y1), below).into();
    }
    large
}

/// The same of what the screen holds. Pixels are mixed as the device reads them: light from an sRGB format, stored values
/// from the other.
fn enlarged_srgb8(mut picture: Picture, format: wgpu::TextureFormat) -> Vec<u8> {
    if format.is_srgb() {
        return enlarged(&picture).to_srgb8(BACKGROUND);
    }
    let bytes = picture.to_srgb8(BACKGROUND);
    for (pixel, rgb) in picture.pixels.iter_mut().zip(bytes.chunks(3)) {
        *pixel = [rgb[0], rgb[1], rgb[2], 255].map(|byte| f32::from(byte) / 255.0);
    }
    let byte = |x: f32| (x * 255.0).round() as u8;
    enlarged(&picture).pixels.iter().flat_map(|p| [p[0], p[1], p[2]].map(byte)).collect()
}

/// Draws a view pass into the right half of a target twice as wide; the bytes of both halves.
fn paint(gpu: &Gpu, pass: &ViewPass, format: wgpu::TextureFormat, size: (u32, u32)) -> [Vec<u8>; 2] {
    paint_by(gpu, format, size, |render_pass| pass.paint(render_pass))
}

fn paint_by(
    gpu: &Gpu,
    format: wgpu::TextureFormat,
    (width, height): (u32, u32),
    draw: impl FnOnce(&mut wgpu::RenderPass<'_>),
) -> [Vec<u8>; 2] {
    let size = wgpu::Extent3d { width: 2 * width, height, depth_or_array_layers: 1 };
    let target = gpu.device().create_texture(&wgpu::TextureDescriptor {
        label: None,
        size,
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format,
        usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::COPY_SRC,
        view_formats: &[],
    });
    let bytes_per_row = (2 * width * 4).next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT);
    let staging = gpu.device().create_buffer(&wgpu::BufferDescriptor {
        label: None,
        size: u64::from(bytes_per_row * height),
        usage: wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ,
        mapped_at_creation: false,
    });
    let mut encoder = gpu.device().create_command_encoder(&Default::default());
    {
        let view = target.create_view(&Default::default());
        let mut render_pass = encoder
            .begin_render_pass(&wgpu::RenderPassDescriptor {
                color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                    view: &view,
                    depth_slice: None,
                    resolve_target: None,
                    ops: wgpu::Operations {
                        load: wgpu::LoadOp::Clear(wgpu::Color::BLACK),
                        store: wgpu::StoreOp::Store,
                    },
                })],
                ..Default::default()
            })
            .forget_lifetime();
        render_pass.set_viewport(width as f32, 0.0, width as f32, height as f32, 0.0, 1.0);
        draw(&mut render_pass);
    }
    encoder.copy_texture_to_buffer(
        target.as_image_copy(),
        wgpu::TexelCopyBufferInfo {
            buffer: &staging,
            layout: wgpu::TexelCopyBufferLayout {
                offset: 0,
                bytes_per_row: Some(bytes_per_row),
                rows_per_image: None,
            },
        },
        size,
    );
    gpu.queue().submit([encoder.finish()]);
    staging.map_async(wgpu::MapMode::Read, .., |result| result.unwrap());
    gpu.device().poll(wgpu::PollType::wait_indefinitely()).unwrap();
    let bytes = staging.get_mapped_range(..).unwrap();
    let half = |from: u32| {
        let row = |y: u32| &bytes[(y * bytes_per_row + from * 4) as usize..][..width as usize * 4];
        (0..height).flat_map(|y| row(y).chunks(4).flat_map(|p| p[..3].to_vec())).collect()
    };
    [half(0), half(width)]
}

/// First draws ahead of time come to an end, with and without a frame, and change nothing that is painted.
#[test]
fn warming_up_draws_with_each_pipeline_and_leaves_no_trace() {
    let Some(gpu) = gpu() else { return };
    let (_, scene) = scenes().swap_remove(2);
    let bounds = scene.volume.bounds();
    let frame = layering::generate(&scene, header(camera(&scene, 25.0, (40, 30)), 8));
    let format = wgpu::TextureFormat::Rgba8Unorm;
    let mut pass = ViewPass::new(gpu.device(), format).unwrap();
    let warm_up = pass.warm_up(gpu.device(), gpu.queue()).unwrap();
    pass.upload(gpu.device(), gpu.queue(), 0, &frame, &bounds).unwrap();
    let view = camera(&scene, 33.0, (40, 30));
    pass.prepare(gpu.queue(), &view, BACKGROUND);
    let [_, before] = paint(gpu, &pass, format, (40, 30));
    let num_drawn = warm_up.run(None, gpu.device(), |commands| Some(gpu.queue().submit([commands]))).unwrap();
    assert_eq!(num_drawn, 7, "one frame and several, by three rules; a smaller picture enlarged");
    let [_, after] = paint(gpu, &pass, format, (40, 30));
    assert_eq!(before, after);
    let twin = raycast::raycast(&frame, &bounds, &view).to_srgb8(BACKGROUND);
    Difference::of_srgb8(&after, &twin).assert_tolerable("after the warm-up");
}

/// The first picture of another mode waits for its pipeline, and the pass says so.
#[test]
fn a_picture_without_a_pipeline_is_not_painted_and_is_said_to_be_missing() {
    let Some(gpu) = gpu() else { return };
    let (_, scene) = scenes().swap_remove(2);
    let bounds = scene.volume.bounds();
    let (format, view) = (wgpu::TextureFormat::Rgba8Unorm, camera(&scene, 25.0, (40, 30)));
    let of = |mode: Mode| {
        let settings = MarchSettings { mode, ..scene.settings };
        let scene = scene.with_look(&isinglass_formats::preset("shells").unwrap(), settings);
        layering::generate(&scene, FrameHeader { mode, ..header(view, 8) })
    };
    let mut pass = ViewPass::new(gpu.device(), format).unwrap();
    let warm_up = pass.warm_up(gpu.device(), gpu.queue()).unwrap();
    let shown = |pass: &mut ViewPass, mode: Mode| {
        pass.upload(gpu.device(), gpu.queue(), 0, &of(mode), &bounds).unwrap();
        pass.prepare(gpu.queue(), &view, BACKGROUND);
        let [_, painted] = paint(gpu, pass, format, (40, 30));
        (pass.can_cast(), painted.iter().any(|byte| *byte != 0))
    };
    assert_eq!(shown(&mut pass, Mode::Composite), (true, true));
    assert_eq!(shown(&mut pass, Mode::Mip), (false, false));
    warm_up.run(None, gpu.device(), |commands| Some(gpu.queue().submit([commands]))).unwrap();
    assert_eq!(shown(&mut pass, Mode::Mip), (true, true));
}

#[test]
fn the_view_pass_paints_what_the_twin_casts() {
    let Some(gpu) = gpu() else { return };
    let (_, scene) = scenes().swap_remove(2);
    let bounds = scene.volume.bounds();
    let frame = layering::generate(&scene, header(camera(&scene, 25.0, (90, 77)), 8));
    for format in [wgpu::TextureFormat::Rgba8Unorm, wgpu::TextureFormat::Rgba8UnormSrgb] {
        let mut pass = ViewPass::new(gpu.device(), format).unwrap();
        let view = camera(&scene, 33.0, (100, 76));
        pass.prepare(gpu.queue(), &view, BACKGROUND);
        let [_, empty] = paint(gpu, &pass, format, (100, 76));
        let background = Picture::new(100, 76).to_srgb8(BACKGROUND);
        Difference::of_srgb8(&empty, &background).assert_tolerable("background before the first frame");

        pass.upload(gpu.device(), gpu.queue(), 0, &frame, &bounds).unwrap();
        for (name, mut view) in views(&scene) {
            view.intrinsics = Intrinsics { width: 100, height: 76, ..view.intrinsics };
            pass.prepare(gpu.queue(), &view, BACKGROUND);
            let [beside, found] = paint(gpu, &pass, format, (100, 76));
            assert!(beside.iter().all(|&x| x == 0), "painted outside of the viewport");
            let twin = raycast::raycast(&frame, &bounds, &view).to_srgb8(BACKGROUND);
            Difference::of_srgb8(&found, &twin).assert_tolerable(&format!("{name}, {format:?}"));
            Difference::of_srgb8(&found, &background).assert_noticed("nothing painted");
        }
        // As many pixels as are shown, apart: to the bit what is painted straight, as often as it is wanted.
        let whole = camera(&scene, 33.0, (100, 76));
        pass.prepare(gpu.queue(), &whole, BACKGROUND);
        let [_, straight] = paint(gpu, &pass, format, (100, 76));
        let mut encoder = gpu.device().create_command_encoder(&Default::default());
        pass.prepare_apart(gpu.device(), gpu.queue(), &mut encoder, &whole, BACKGROUND, None);
        gpu.queue().submit([encoder.finish()]);
        let again =
            |pass: &ViewPass| paint_by(gpu, format, (100, 76), |render_pass| pass.paint_apart(render_pass));
        let [beside, apart] = again(&pass);
        assert!(apart == straight && beside.iter().all(|&x| x == 0), "{format:?}");
        pass.prepare(gpu.queue(), &camera(&scene, 60.0, (100, 76)), BACKGROUND);
        assert!(paint(gpu, &pass, format, (100, 76))[1] != straight, "another camera was not noticed");
        assert!(again(&pass)[1] == straight, "it was cast again");
        // Half as many pixels each way, enlarged: the same as the twin's picture of that size, enlarged by hand.
        let smaller =
            Camera { intrinsics: Intrinsics { width: 50, height: 38, ..whole.intrinsics }, ..whole };
        let mut encoder = gpu.device().create_command_encoder(&Default::default());
        pass.prepare_apart(gpu.device(), gpu.queue(), &mut encoder, &smaller, BACKGROUND, None);
        gpu.queue().submit([encoder.finish()]);
        let [_, found] = paint_by(gpu, format, (100, 76), |render_pass| pass.paint_apart(render_pass));
        let twin = enlarged_srgb8(raycast::raycast(&frame, &bounds, &smaller), format);
        let difference = Difference::of_srgb8(&found, &twin);
        assert!(difference.is_tolerable_enlarged(), "enlarged, {format:?}: {difference:?}");
        let full = raycast::raycast(&frame, &bounds, &whole).to_srgb8(BACKGROUND);
        assert!(
            !Difference::of_srgb8(&found, &full).is_tolerable_enlarged(),
            "half of the pixels were not noticed"
        );
        // Another slot for an older frame, of another size, shown along with the newest.
        let older = header(camera(&scene, 80.0, (61, 50)), 8);
        let older = layering::generate(&scene, older);
        pass.upload(gpu.device(), gpu.queue(), 5, &older, &bounds).unwrap();
        let aside = |degrees: f32, distance: f32| {
            let pose =
                Pose::orbit(bounds.center(), f32::to_radians(degrees), 0.35, distance * bounds.radius());
            Camera::new(pose, whole.intrinsics, &bounds)
        };
        let newest = header(Camera { intrinsics: frame.header.camera.intrinsics, ..aside(30.0, 0.8) }, 8);
        let newest = layering::generate(&scene, newest);
        pass.upload(gpu.device(), gpu.queue(), 0, &newest, &bounds).unwrap();
        let whole = aside(45.0, 0.9);
        let draw = |pass: &mut ViewPass, slots: &[usize]| {
            pass.show(gpu.device(), slots).unwrap();
            pass.prepare(gpu.queue(), &whole, BACKGROUND);
            let [_, found] = paint(gpu, pass, format, (100, 76));
            found
        };
        let twin = combine::combine(&[&newest, &older], &bounds, &whole).to_srgb8(BACKGROUND);
        let alone = raycast::raycast(&newest, &bounds, &whole).to_srgb8(BACKGROUND);
        Difference::of_srgb8(&draw(&mut pass, &[0, 5]), &twin).assert_tolerable("two frames");
        Difference::of_srgb8(&draw(&mut pass, &[0, 5]), &alone).assert_noticed("the older frame");
        Difference::of_srgb8(&draw(&mut pass, &[0]), &alone).assert_tolerable("one frame again");
        Difference::of_srgb8(&draw(&mut pass, &[0, 3]), &alone).assert_tolerable("an empty slot");
        // A frame of another size in a slot that is shown.
        pass.show(gpu.device(), &[0, 5]).unwrap();
        let larger = header(camera(&scene, 80.0, (120, 100)), 8);
        let larger = layering::generate(&scene, larger);
        pass.upload(gpu.device(), gpu.queue(), 5, &larger, &bounds).unwrap();
        let twin = combine::combine(&[&newest, &larger], &bounds, &whole).to_srgb8(BACKGROUND);
        Difference::of_srgb8(&draw(&mut pass, &[0, 5]), &twin).assert_tolerable("a larger frame");
        // Enlarged from a smaller picture.
        let smaller =
            Camera { intrinsics: Intrinsics { width: 50, height: 38, ..whole.intrinsics }, ..whole };
        let mut encoder = gpu.device().create_command_encoder(&Default::default());
        pass.prepare_apart(gpu.device(), gpu.queue(), &mut encoder, &smaller, BACKGROUND, None);
        gpu.queue().submit([encoder.finish()]);
        let [_, found] = paint_by(gpu, format, (100, 76), |render_pass| pass.paint_apart(render_pass));
        let twin = enlarged_srgb8(combine::combine(&[&newest, &larger], &bounds, &smaller), format);
        let difference = Difference::of_srgb8(&found, &twin);
        assert!(difference.is_tolerable_enlarged(), "several frames, enlarged: {difference:?}");
        let mut bad = frame.clone();
        bad.offsets.pop();
        assert!(pass.upload(gpu.device(), gpu.queue(), 0, &bad, &bounds).is_err());
    }
}
