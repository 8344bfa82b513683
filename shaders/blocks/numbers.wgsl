// Numbers of 64 bits as two words, the lower first, and bits of masks of 64 lists.

fn product(a: i32, b: i32) -> vec2u {
    let x = bitcast<u32>(a);
    let y = bitcast<u32>(b);
    let low = (x & 0xffffu) * (y & 0xffffu);
    let middle = (x >> 16u) * (y & 0xffffu) + (low >> 16u);
    let other = (x & 0xffffu) * (y >> 16u) + (middle & 0xffffu);
    var high = (x >> 16u) * (y >> 16u) + (middle >> 16u) + (other >> 16u);
    // Of negative numbers, the other one is too much in the upper word.
    high -= select(0u, y, a < 0) + select(0u, x, b < 0);
    return vec2u((other << 16u) | (low & 0xffffu), high);
}

fn sum64(a: vec2u, b: vec2u) -> vec2u {
    let low = a.x + b.x;
    return vec2u(low, a.y + b.y + select(0u, 1u, low < a.x));
}

fn negative64(a: vec2u) -> vec2u {
    return sum64(~a, vec2u(1u, 0u));
}

// The lower word of a number shifted to the right by less than 32.
fn shifted(a: vec2u, bits: u32) -> i32 {
    return bitcast<i32>(select((a.x >> bits) | (a.y << (32u - bits)), a.x, bits == 0u));
}

// A number shifted to the left by less than 32.
fn shifted_up(a: i32, bits: u32) -> vec2u {
    let low = bitcast<u32>(a);
    return vec2u(low << bits, bitcast<u32>(select(a >> (32u - bits), a >> 31u, bits == 0u)));
}

fn is_less(a: vec2u, b: vec2u) -> bool {
    return a.y < b.y || (a.y == b.y && a.x < b.x);
}

// The whole part of the quotient of positive numbers, which is less than 2²³.
fn quotient64(number: vec2u, by: u32) -> u32 {
    var rest = number;
    var found = 0u;
    for (var bits = 23u; bits > 0u; bits--) {
        let part = vec2u(by << (bits - 1u), select(by >> (33u - bits), 0u, bits == 1u));
        if (!is_less(rest, part)) {
            rest = sum64(rest, negative64(part));
            found |= 1u << (bits - 1u);
        }
    }
    return found;
}

fn bit_of(mask: vec2u, list: u32) -> bool {
    return ((select(mask.x, mask.y, list >= 32u) >> (list & 31u)) & 1u) == 1u;
}

fn mask_of(list: u32) -> vec2u {
    let bit = 1u << (list & 31u);
    return select(vec2u(bit, 0u), vec2u(0u, bit), list >= 32u);
}

fn num_bits(mask: vec2u) -> u32 {
    return countOneBits(mask.x) + countOneBits(mask.y);
}

// Number of lists of a mask in front of a list.
fn rank(mask: vec2u, list: u32) -> u32 {
    let below = (1u << (list & 31u)) - 1u;
    return select(countOneBits(mask.x & below), countOneBits(mask.x) + countOneBits(mask.y & below), list >= 32u);
}

fn is_empty(mask: vec2u) -> bool {
    return (mask.x | mask.y) == 0u;
}

fn is_full(mask: vec2u) -> bool {
    return (mask.x & mask.y) == 0xffffffffu;
}

// The eight lists of a row of a mask.
fn row_of(mask: vec2u, row: u32) -> u32 {
    return (select(mask.x, mask.y, row >= 4u) >> (8u * (row & 3u))) & 0xffu;
}

fn i16_at(word: u32, half: u32) -> i32 {
    return bitcast<i32>(word << (16u - 16u * half)) >> 16u;
}

fn u16_at(word: u32, half: u32) -> u32 {
    return (word >> (16u * half)) & 0xffffu;
}
