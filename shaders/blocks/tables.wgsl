// The probabilities that follow from what a frame and those before had in each context (twin of
// crates/core/src/codec/blocks/tables.rs). An invocation has two contexts.

@group(0) @binding(0) var<storage, read> prior: array<u32>;
// How often each context had a zero and a one, in sixteenths, in the reference's frames; nothing without one.
@group(0) @binding(1) var<storage, read> counts_before: array<vec2u>;
@group(0) @binding(2) var<storage, read> tally: array<vec2u>;
@group(0) @binding(3) var<storage, read_write> counts_after: array<vec2u>;
@group(0) @binding(4) var<storage, read_write> probabilities: array<u32>;

@compute @workgroup_size(64)
fn make_tables(@builtin(global_invocation_id) id: vec3u) {
    if (2u * id.x >= arrayLength(&counts_after)) {
        return;
    }
    let word = prior[id.x];
    probabilities[id.x] = probability(2u * id.x, word & 0xffffu) | (probability(2u * id.x + 1u, word >> 16u) << 16u);
}

fn probability(context: u32, prior_one: u32) -> u32 {
    let before = counts_before[context];
    let counts = capped_sum((before >> vec2u(1u)) + (before >> vec2u(3u)), tally[context]);
    counts_after[context] = counts;
    // So the numerator has 32 bits.
    let bits = 32u - countLeadingZeros(counts.x | counts.y);
    let shift = max(bits, 16u) - 16u;
    let weighed = counts >> vec2u(shift);
    let one = ((weighed.y << 15u) + PRIOR_WEIGHT * prior_one) / (weighed.x + weighed.y + PRIOR_WEIGHT);
    return clamp(one, 24u, 32768u - 24u);
}

// Sixteen times the bits of a frame are added; the most is 2³² − 1.
fn capped_sum(counts: vec2u, bits: vec2u) -> vec2u {
    let more = select(bits << vec2u(4u), vec2u(0xffffffffu), bits > vec2u(0x0fffffffu));
    let sum = counts + more;
    return select(sum, vec2u(0xffffffffu), sum < counts);
}

const PRIOR_WEIGHT: u32 = 96u;
