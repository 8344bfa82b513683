// Reads the bits of a tile (twin of crates/core/src/codec/blocks/entropy.rs). One invocation of a workgroup does.

var<private> state: u32;
// The next word of 16 bits, and that behind the last, in `payload`.
var<private> next_word: u32;
var<private> end_word: u32;
var<private> first_probability: u32;

// Begins with a stream: its first word, their number, and the first word of its probabilities.
fn open_stream(stream: vec3u) {
    next_word = stream.x;
    end_word = stream.x + stream.y;
    first_probability = stream.z;
    let low = take_word();
    state = low | (take_word() << 16u);
}

fn take_word() -> u32 {
    var word = 0u;
    if (next_word < end_word) {
        word = u16_at(payload[next_word >> 1u], next_word & 1u);
    }
    next_word++;
    return word;
}

fn is_overrun() -> bool {
    return next_word > end_word;
}

fn is_at_end() -> bool {
    return next_word == end_word && state == LEAST_STATE;
}

fn decode(one: u32) -> bool {
    let low = state & 0x7fffu;
    let bit = low < one;
    let start = select(one, 0u, bit);
    let width = select(32768u - one, one, bit);
    state = width * (state >> 15u) + low - start;
    if (state < LEAST_STATE) {
        state = (state << 16u) | take_word();
    }
    return bit;
}

// A bit with the probability of a context.
fn bit(context: u32) -> bool {
    let bit = decode(u16_at(probabilities[first_probability + (context >> 1u)], context & 1u));
    atomicAdd(&tally[2u * context + u32(bit)], 1u);
    return bit;
}

fn bit_number(context: u32) -> u32 {
    return u32(bit(context));
}

// `count` equally likely bits, highest first.
fn raw(count: u32) -> u32 {
    var value = 0u;
    for (var i = 0u; i < count; i++) {
        value = (value << 1u) | u32(decode(16384u));
    }
    return value;
}

fn tree(contexts: u32, count: u32) -> u32 {
    var node = 1u;
    for (var i = 0u; i < count; i++) {
        node = (node << 1u) | bit_number(contexts + node);
    }
    return node & ((1u << count) - 1u);
}

// Number of ones before the first zero, at most `most`.
fn unary(contexts: u32, most: u32) -> u32 {
    var value = 0u;
    while (value < most && bit(contexts + value)) {
        value++;
    }
    return value;
}

fn number(contexts: u32) -> u32 {
    let length = unary(contexts, NUMBER_BITS);
    if (length == 0u) {
        return 0u;
    }
    let rest = length - 1u;
    let first = bit_number(contexts + NUMBER_BITS + rest);
    let low = raw(rest);
    return (((2u | first) << rest) | low) - 1u;
}

fn signed_number(contexts: u32) -> i32 {
    if (!bit(contexts)) {
        return 0;
    }
    let is_negative = bit(contexts + 1u);
    let size = i32(number(contexts + 2u)) + 1;
    return select(size, -size, is_negative);
}

const LEAST_STATE: u32 = 65536u;
const NUMBER_BITS: u32 = 20u;
