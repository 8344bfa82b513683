// The scales of a cell's opacity and colour (twin of crates/core/src/codec/blocks/scales.rs). `scales` has its tables.

fn opacity_of(code: i32) -> i32 {
    return bitcast<i32>(scales[code] & 0xffffu);
}

fn log_of_tau(code: i32) -> i32 {
    return bitcast<i32>(scales[code]) >> 16u;
}

fn code_of_log(log: i32) -> i32 {
    let place = u32(clamp((log - LEAST_LOG) / LOG_STEP, 0, NUM_LOGS - 1));
    return i32(u16_at(scales[CODES_OF_LOGS + (place >> 1u)], place & 1u));
}

// log₂ of a number from 1 to 2²⁴, which is exact as a float.
fn log_of(number: i32) -> i32 {
    let bits = bitcast<u32>(f32(number));
    let mantissa = (bits >> 13u) & 1023u;
    return (i32(bits >> 23u) - 127) * LOG_ONE + i16_at(scales[LOGS_OF_MANTISSAS + (mantissa >> 1u)], mantissa & 1u);
}

fn log_of_sum(a: i32, b: i32) -> i32 {
    let below = u32((max(a, b) - min(a, b)) / BELOW_STEP);
    if (below >= NUM_BELOWS) {
        return max(a, b);
    }
    return max(a, b) + i16_at(scales[LOGS_OF_SUMS + (below >> 1u)], below & 1u);
}

// A step over the root of a number in units of 2⁻¹⁶.
fn per_root(step: u32, number: i32) -> i32 {
    let place = u32(clamp(number / 64, 0, 1023));
    return max(i32((step * u16_at(scales[PER_ROOTS + (place >> 1u)], place & 1u)) >> 12u), 1);
}

fn wave(frequency: u32, place: u32) -> i32 {
    return bitcast<i32>(scales[WAVES + 8u * frequency + place]);
}

fn zigzag(k: u32) -> u32 {
    return scales[ZIGZAG + k];
}

fn code_from_quarters(quarters: i32) -> i32 {
    return (clamp(quarters, 4, 4 * 4095) + 2) >> 2u;
}

// What is left of a transmittance behind an opacity, in units of 2⁻¹⁶.
fn behind(kappa: i32, opacity: i32) -> i32 {
    return i32((u32(kappa) * u32(65536 - opacity) + 32768u) >> 16u);
}

fn seen(kappa: i32, opacity: i32) -> i32 {
    return i32((u32(kappa) * u32(opacity)) >> 16u);
}

const UNIT: i32 = 65536;
const LOG_ONE: i32 = 1024;
const LEAST_LOG: i32 = -24576;
const LOG_STEP: i32 = 4;
const BELOW_STEP: i32 = 16;
const NUM_LOGS: i32 = 8704;
const NUM_BELOWS: u32 = 704;

// Words of the tables.
const CODES_OF_LOGS: u32 = 4096;
const LOGS_OF_MANTISSAS: u32 = 8448;
const LOGS_OF_SUMS: u32 = 8960;
const PER_ROOTS: u32 = 9312;
const WAVES: u32 = 9824;
const ZIGZAG: u32 = 9888;
const ALPHAS: u32 = 9952;
const HALVES_OF_TAU: u32 = 14048;
