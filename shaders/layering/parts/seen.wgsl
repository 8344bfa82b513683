// What is seen of a ray in the part (render/*.wgsl), for a picture. Twin of crates/core/src/kernels/part_pictures.rs.

const ITEM_WORDS: u32 = 4u;

fn gather_items(ray: Ray, lattice: Lattice) {
    let found = bitcast<vec4u>(collected(ray, lattice));
    put_word(0u, found.x);
    put_word(1u, found.y);
    put_word(2u, found.z);
    put_word(3u, found.w);
    end_item();
}
