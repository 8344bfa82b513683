"""Times VTK's vtkFixedPointVolumeRayCastMapper on the scene of `isinglass render VOLUME --orbit AZ,EL`.

The same volume, camera, picture size, step (half a voxel), control points and shading coefficients; the light is VTK's
headlight. VTK composites in 15-bit fixed point, classifies samples (not steps) and takes shading from directions that
it quantises and tabulates before the first frame, which is not timed. Run it by hand beside `isinglass bench speed`:

    pip install vtk numpy
    python crates/bench/vtk/vtk_time.py bonsai.nrrd --preset configs/presets/ct.toml --threads 2

Reads NRRD files with attached raw or gzip data of one scalar a voxel, axes as stored, and prints one line of JSON.
"""

import argparse
import gzip
import json
import math
import statistics
import time
import tomllib

import numpy as np
import vtk
from vtk.util.numpy_support import numpy_to_vtk

TYPES = {"uint8": "u1", "uchar": "u1", "unsigned char": "u1", "uint16": "u2", "ushort": "u2", "unsigned short": "u2",
         "int16": "i2", "short": "i2", "float": "f4"}


def read_nrrd(path):
    """Voxels as an array indexed [z, y, x], and the three spacings."""
    with open(path, "rb") as file:
        raw = file.read()
    end = raw.index(b"\n\n")
    fields = dict(
        (line.split(":", 1)[0].strip(), line.split(":", 1)[1].strip())
        for line in raw[:end].decode().splitlines()
        if ":" in line and not line.startswith("#")
    )
    data = raw[end + 2:]
    if fields["encoding"] in ("gzip", "gz"):
        data = gzip.decompress(data)
    sizes = [int(s) for s in fields["sizes"].split()]
    dtype = np.dtype(TYPES[fields["type"]]).newbyteorder(">" if fields.get("endian") == "big" else "<")
    voxels = np.frombuffer(data, dtype, count=math.prod(sizes)).reshape(sizes[::-1])
    if "spacings" in fields:
        spacing = [float(s) for s in fields["spacings"].split()]
    elif "space directions" in fields:
        vectors = fields["space directions"].replace("(", " ").replace(")", " ").replace(",", " ").split()
        spacing = list(np.linalg.norm(np.array(vectors, float).reshape(3, 3), axis=1))
    else:
        spacing = [1.0, 1.0, 1.0]
    return voxels.astype(dtype.newbyteorder("=")), spacing


def make_property(preset_path, voxels, spacing, shaded):
    """The control points as VTK's piecewise functions over stored values."""
    with open(preset_path, "rb") as file:
        preset = tomllib.load(file)
    domain = preset["domain"]
    if isinstance(domain, dict) and "percentiles" in domain:
        lo, hi = np.percentile(voxels, domain["percentiles"])
    elif isinstance(domain, dict):
        lo, hi = domain["values"]
    else:
        lo, hi = voxels.min(), voxels.max()
    unit = preset["unit_length"]
    radius = 0.5 * math.sqrt(sum((n * s) ** 2 for n, s in zip(voxels.shape[::-1], spacing)))
    if unit == "voxel":
        unit_length = math.prod(spacing) ** (1.0 / 3.0)
    else:
        unit_length = unit["radius"] * radius if "radius" in unit else unit["world"]
    opacity, color = vtk.vtkPiecewiseFunction(), vtk.vtkColorTransferFunction()
    for point in preset["point"]:
        x = lo + point["x"] * (hi - lo)
        opacity.AddPoint(x, point["opacity"])
        color.AddRGBPoint(x, *(int(point["color"][i:i + 2], 16) / 255.0 for i in (1, 3, 5)))
    prop = vtk.vtkVolumeProperty()
    prop.SetScalarOpacity(opacity)
    prop.SetColor(color)
    prop.SetScalarOpacityUnitDistance(unit_length)
    prop.SetInterpolationTypeToLinear()
    prop.SetShade(shaded)
    prop.SetAmbient(0.25)
    prop.SetDiffuse(0.85)
    prop.SetSpecular(0.0)
    return prop, radius


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("volume")
    parser.add_argument("--preset", required=True, help="TOML file of a transfer function")
    parser.add_argument("--orbit", default="30,20", help="azimuth and elevation, degrees")
    parser.add_argument("--size", default="512x512")
    parser.add_argument("--fov", type=float, default=40.0, help="vertical, degrees")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--unshaded", action="store_true")
    parser.add_argument("--output", help="PNG file for a look at the picture")
    args = parser.parse_args()

    voxels, spacing = read_nrrd(args.volume)
    width, height = (int(n) for n in args.size.split("x"))
    image = vtk.vtkImageData()
    image.SetDimensions(*voxels.shape[::-1])
    image.SetSpacing(*spacing)
    image.SetOrigin(*(-0.5 * (n - 1) * s for n, s in zip(voxels.shape[::-1], spacing)))
    image.GetPointData().SetScalars(numpy_to_vtk(voxels.ravel(), deep=True))

    mapper = vtk.vtkFixedPointVolumeRayCastMapper()
    mapper.SetInputData(image)
    mapper.SetAutoAdjustSampleDistances(False)
    mapper.SetSampleDistance(0.5 * min(spacing))
    mapper.SetInteractiveSampleDistance(0.5 * min(spacing))
    mapper.SetImageSampleDistance(1.0)
    mapper.SetNumberOfThreads(args.threads)
    volume = vtk.vtkVolume()
    volume.SetMapper(mapper)
    prop, radius = make_property(args.preset, voxels, spacing, not args.unshaded)
    volume.SetProperty(prop)

    renderer = vtk.vtkRenderer()
    renderer.AddVolume(volume)
    window = vtk.vtkRenderWindow()
    window.SetOffScreenRendering(True)
    window.SetSize(width, height)
    window.AddRenderer(renderer)
    azimuth, elevation = (math.radians(float(a)) for a in args.orbit.split(","))
    distance = radius / math.sin(math.radians(args.fov) / 2)
    camera = renderer.GetActiveCamera()
    camera.SetFocalPoint(0, 0, 0)
    camera.SetPosition(distance * math.sin(azimuth) * math.cos(elevation), distance * math.sin(elevation),
                       distance * math.cos(azimuth) * math.cos(elevation))
    camera.SetViewUp(0, 1, 0)
    camera.SetViewAngle(args.fov)
    renderer.ResetCameraClippingRange()

    window.Render()
    frame_ms, cpu_ms = [], []
    for _ in range(args.repeats):
        start, cpu_start = time.perf_counter(), time.process_time()
        window.Render()
        frame_ms.append((time.perf_counter() - start) * 1e3)
        cpu_ms.append((time.process_time() - cpu_start) * 1e3)
    print(json.dumps({
        "vtk": vtk.vtkVersion().GetVTKVersion(),
        "threads": mapper.GetNumberOfThreads(),
        "size": [width, height],
        # Of the clock, and of all threads: the sum of their times depends less on what else runs.
        "median_ms": round(statistics.median(frame_ms), 1),
        "min_ms": round(min(frame_ms), 1),
        "cpu_min_ms": round(min(cpu_ms), 1),
    }))
    if args.output:
        grab = vtk.vtkWindowToImageFilter()
        grab.SetInput(window)
        writer = vtk.vtkPNGWriter()
        writer.SetFileName(args.output)
        writer.SetInputConnection(grab.GetOutputPort())
        writer.Write()


if __name__ == "__main__":
    main()
