// Where a frame's point lies in the reference (twin of crates/core/src/codec/blocks/motion.rs).

// Motion of a point: 64ths of a pixel, sixteenths of a depth unit.
struct Shift {
    to: vec3i,
    is_seen: bool,
}

// Motion of the point at a pixel and a depth, sixteenths of a depth unit.
fn shift_of(at: vec2i, z: i32) -> Shift {
    if (frame.is_still == 1u) {
        return Shift(vec3i(0), true);
    }
    let near = clamp(z, -MAX_Z, MAX_Z);
    let weight = coordinate(2u, at, near);
    if (weight <= 0) {
        return Shift(vec3i(0), false);
    }
    let x = moved(coordinate(0u, at, near), weight);
    let y = moved(coordinate(1u, at, near), weight);
    let units = (coordinate(3u, at, near) + (1 << (UNITS_BITS - 1u))) >> UNITS_BITS;
    let to = vec3i(x - 64 * at.x, y - 64 * at.y, units - z);
    return Shift(to, all(abs(to) < vec3i(MAX_SHIFT)));
}

fn coordinate(i: u32, at: vec2i, z: i32) -> i32 {
    return shifted(product(times(frame.along[i], at), z), ALONG_BITS) + times(frame.here[i], at);
}

fn times(row: vec4i, at: vec2i) -> i32 {
    return shifted(sum64(product(row.x, at.x), product(row.y, at.y)), frame.shift) + row.z;
}

// A coordinate over the weight, to the nearest 64th of a pixel, or `TOO_FAR`.
fn moved(coordinate: i32, weight: i32) -> i32 {
    let by = 2u * u32(weight);
    let number = sum64(shifted_up(coordinate, frame.shift + 7u), vec2u(u32(weight), 0u));
    let is_negative = (number.y >> 31u) == 1u;
    var size = number;
    if (is_negative) {
        // Rounds down.
        size = sum64(negative64(number), vec2u(by - 1u, 0u));
    }
    if (!is_less(size, vec2u(by << 23u, by >> 9u))) {
        return TOO_FAR;
    }
    let nearest = i32(quotient64(size, by));
    return select(nearest, -nearest, is_negative);
}

const ALONG_BITS: u32 = 20u;
const UNITS_BITS: u32 = 5u;
const MAX_Z: i32 = 2097152;
const MAX_SHIFT: i32 = 4194304;
const TOO_FAR: i32 = 8388608;
