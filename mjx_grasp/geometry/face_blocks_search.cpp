// The body of `search` in face_blocks_kernel.py: the slot of the face nearest to `point`.
//
// In C++ with vectors of eight numbers, because Warp's compiler does not make them of loops. They
// are Clang's (and GCC's): any processor will do. The nearest face by its edges, and, where the
// projection lies inside, by its plane: as `closest._weights` has it.
typedef float f8 __attribute__((vector_size(32), aligned(4)));
typedef int i8 __attribute__((vector_size(32), aligned(4)));
const f8 zero = {}, one = zero + 1.0f;
const f8 px = zero + point[0], py = zero + point[1], pz = zero + point[2];
float best = 1e30f;

auto smaller = [](f8 a, f8 b) -> f8 { return a < b ? a : b; };
auto larger = [](f8 a, f8 b) -> f8 { return a > b ? a : b; };
auto to_edge = [&](f8 x, f8 y, f8 z, f8 ux, f8 uy, f8 uz, f8 inverse) -> f8 {
    f8 t = smaller(larger((x * ux + y * uy + z * uz) * inverse, zero), one);
    f8 a = x - t * ux, b = y - t * uy, c = z - t * uz;
    return a * a + b * b + c * c;
};
auto look_at = [&](int block) {
    const f8* r = (const f8*)blocks.data + 18 * block;
    f8 x = px - r[0], y = py - r[1], z = pz - r[2];
    f8 ux = r[3], uy = r[4], uz = r[5], wx = r[6], wy = r[7], wz = r[8];
    f8 d = to_edge(x, y, z, ux, uy, uz, r[15]);
    d = smaller(d, to_edge(x, y, z, wx, wy, wz, r[16]));
    d = smaller(d, to_edge(x - ux, y - uy, z - uz, wx - ux, wy - uy, wz - uz, r[17]));
    f8 v = x * r[9] + y * r[10] + z * r[11], w = x * r[12] + y * r[13] + z * r[14];
    f8 a = x - v * ux - w * wx, b = y - v * uy - w * wy, c = z - v * uz - w * wz;
    i8 inside = (v > zero) & (w > zero) & (v + w < one);
    d = inside ? a * a + b * b + c * c : d;
    for (int k = 0; k < 8; ++k)
        if (d[k] < best) { best = d[k]; slot = 8 * block + k; }
};

const int known = slot < 0 ? -1 : slot / 8;
if (known >= 0) look_at(known);
// Seven siblings wait at each of at most twelve levels.
int node[96], waiting = 1;
float distance[96];
node[0] = root, distance[0] = 0.0f;
while (waiting > 0) {
    if (distance[--waiting] >= best) continue;
    const int here = node[waiting];
    const f8* r = (const f8*)boxes.data + 6 * here;
    f8 x = larger(larger(r[0] - px, px - r[3]), zero);
    f8 y = larger(larger(r[1] - py, py - r[4]), zero);
    f8 z = larger(larger(r[2] - pz, pz - r[5]), zero);
    f8 d = x * x + y * y + z * z;
    const int child = first.data[here];
    const int bottom = waiting;
    for (int k = 0; k < 8; ++k) {
        if (!(d[k] < best)) continue;
        if (child < 0) {
            const int block = first_block - 1 - child + k;
            if (block != known) look_at(block);
            continue;
        }
        // The nearest on top.
        int at = waiting++;
        for (; at > bottom && distance[at - 1] < d[k]; --at)
            node[at] = node[at - 1], distance[at] = distance[at - 1];
        node[at] = root + child + k, distance[at] = d[k];
    }
}
return slot;
