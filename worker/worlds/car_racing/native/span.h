/* Spans of an interior: how pygame rounds and clips them. */
#ifndef DREAMFLEET_SPAN_H
#define DREAMFLEET_SPAN_H

#include "canvas.h"

static const Span EMPTY = {WIDTH, -1};

static inline Span span_of(int left, int right)
{
    int first = MAX(MIN(left, right), 0), last = MIN(MAX(left, right), WIDTH - 1);
    return first <= last ? (Span){(int16_t)first, (int16_t)last} : EMPTY;
}

/* The span between two crossings. */
static inline Span between(int a, int b)
{
    a++;
    b--;
    return span_of((int16_t)((a >> 16) + ((a & 32768) >> 15)), (int16_t)((b >> 16) + ((b & 32768) >> 15)));
}

#endif
