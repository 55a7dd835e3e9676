// What a block does not train, drawn once for a view as layers behind and in front of the block:
// layers: uchar[3 or 7, H, W], the colour B behind it with the background, and WITH_FRONT the
// colour F in front of it and the transmittance T of that; 255 is one.
//   C = F + T (C_block + T_block B)
#define LAYER_UNIT ((real)(1.0 / 255))
#define FRONT_PLANE 3
#define FRONT_CLEAR_PLANE 6
#define ONE_BYTE(P) (*(P)*LAYER_UNIT)
#define SIXTEEN_BYTES(P) (convert_real16(vload16(0, P)) * LAYER_UNIT)
