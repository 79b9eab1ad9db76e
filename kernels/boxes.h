/* Boxes: the layout of the morphologies of all sources and scenes in one flat buffer.
 *
 *         0      x0     x0 + nx
 *       0 +------+---------+------ model frame of `scene`
 *         |
 *      y0 +      +---------+
 *         |      |    +    |       the box of source s: ny x nx pixels, its centre pixel + at
 * y0 + ny +      +---------+       (cy, cx), counted from the box's first pixel
 *
 * table (S, N_COLUMNS) int, a row a source with the columns below; solver/boxes.py writes it.
 * Source s owns the elements BEGIN .. BEGIN + ny * nx - 1 of each flat buffer, row by row. Boxes
 * begin at multiples of ALIGN elements; the elements between two boxes are never read.
 */
#ifndef ALIGN       /* elements; the host defines the value of solver/boxes.py */
#define ALIGN 16
#endif

enum { SCENE, Y0, X0, NY, NX, CY, CX, OFFSET, N_COLUMNS };

#define BOX(s) (table + N_COLUMNS * (size_t)(s))
#define BEGIN(box) ((size_t)(box)[OFFSET] * ALIGN)
