/* A balanced tree of boxes: Box2D's broad phase. What it finds does not depend on its shape, but the numbers of its
   leaves do, once bodies of an earlier episode were removed; and they decide in which order contacts begin. */
#ifndef DREAMFLEET_TREE_H
#define DREAMFLEET_TREE_H

#include "plane.h"

enum { NOBODY = -1, TREE_DEPTH = 128 };

typedef struct {
    Box box;
    int parent; /* of a free node: the next free one */
    int children[2];
    int height;
    int owner; /* what the leaf stands for */
} Node;

typedef struct {
    Node *nodes;
    int capacity, used; /* nodes from `used` on were never given out */
    int root, free;
} Tree;

void tree_init(Tree *tree);
void tree_free(Tree *tree);

/* Makes room for so many leaves more; false if there is no memory. */
bool tree_reserve(Tree *tree, int leaves);

/* A new leaf around a box. The tree must have room. */
int tree_add(Tree *tree, Box box, int owner);
void tree_remove(Tree *tree, int leaf);

/* The leaf's body moved by `way` and lies within `box` now; true if the leaf's own box had to follow. */
bool tree_move(Tree *tree, int leaf, Box box, Vec way);

/* Every leaf whose box meets this one's; how many of at most `room` were found. */
int tree_query(const Tree *tree, int leaf, int *found, int room);

#endif
