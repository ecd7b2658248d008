/* Box2D's tree of boxes: a new leaf goes where the perimeters grow least, and sides that differ by more than one level
   are rotated. Node numbers are reused last in, first out. */

#include "tree.h"

#include <stdlib.h>

static const float MARGIN_AROUND = 0.1f; /* a leaf's box is so much larger, so that small moves change nothing */
static const float LEAD = 2.0f;          /* and so many moves longer towards where the body goes */

void tree_init(Tree *tree)
{
    *tree = (Tree){.root = NOBODY, .free = NOBODY};
}

void tree_free(Tree *tree)
{
    free(tree->nodes);
    tree_init(tree);
}

bool tree_reserve(Tree *tree, int leaves)
{
    int wanted = tree->used + 2 * leaves;
    if (wanted <= tree->capacity)
        return true;
    Node *nodes = realloc(tree->nodes, (size_t)wanted * sizeof(Node));
    if (!nodes)
        return false;
    tree->nodes = nodes;
    tree->capacity = wanted;
    return true;
}

static int take(Tree *tree)
{
    int index = tree->free;
    if (index == NOBODY)
        index = tree->used++;
    else
        tree->free = tree->nodes[index].parent;
    tree->nodes[index] = (Node){.parent = NOBODY, .children = {NOBODY, NOBODY}};
    return index;
}

static void give(Tree *tree, int index)
{
    tree->nodes[index].parent = tree->free;
    tree->free = index;
}

static bool is_leaf(const Node *node)
{
    return node->children[0] == NOBODY;
}

/* Box and height of an inner node from its children's. */
static void refit(Tree *tree, int index)
{
    Node *node = &tree->nodes[index];
    const Node *left = &tree->nodes[node->children[0]], *right = &tree->nodes[node->children[1]];
    node->box = box_join(left->box, right->box);
    node->height = 1 + (left->height > right->height ? left->height : right->height);
}

/* Puts `after` where `before` hung under `parent`. */
static void replace(Tree *tree, int parent, int before, int after)
{
    if (parent == NOBODY)
        tree->root = after;
    else
        tree->nodes[parent].children[tree->nodes[parent].children[1] == before] = after;
    tree->nodes[after].parent = parent;
}

/* Lifts the higher child above its parent if it is more than one level higher; says which node stands on top. The
   lifted child keeps the higher of its own children, and the second if they are equally high. */
static int balance(Tree *tree, int index)
{
    Node *nodes = tree->nodes, *node = &nodes[index];
    if (is_leaf(node) || node->height < 2)
        return index;
    int lean = nodes[node->children[1]].height - nodes[node->children[0]].height;
    if (lean >= -1 && lean <= 1)
        return index;
    int side = lean > 1, up = node->children[side];
    int keep = nodes[up].children[0], pass = nodes[up].children[1];
    if (nodes[keep].height <= nodes[pass].height) {
        int lower = keep;
        keep = pass;
        pass = lower;
    }
    replace(tree, node->parent, index, up);
    nodes[up].children[0] = index;
    nodes[up].children[1] = keep;
    node->parent = up;
    node->children[side] = pass;
    nodes[pass].parent = index;
    refit(tree, index);
    refit(tree, up);
    return up;
}

static void mend_upwards(Tree *tree, int index)
{
    while (index != NOBODY) {
        index = balance(tree, index);
        refit(tree, index);
        index = tree->nodes[index].parent;
    }
}

/* What it costs to bring a box under a node: how much its perimeter grows, or all of the new parent's above a leaf. */
static float cost_under(const Node *node, Box box, float inherited)
{
    float perimeter = box_perimeter(box_join(box, node->box));
    return (is_leaf(node) ? perimeter : perimeter - box_perimeter(node->box)) + inherited;
}

static int find_sibling(const Tree *tree, Box box)
{
    int index = tree->root;
    while (!is_leaf(&tree->nodes[index])) {
        const Node *node = &tree->nodes[index];
        float joined = box_perimeter(box_join(node->box, box));
        float here = 2.0f * joined, inherited = 2.0f * (joined - box_perimeter(node->box));
        float left = cost_under(&tree->nodes[node->children[0]], box, inherited);
        float right = cost_under(&tree->nodes[node->children[1]], box, inherited);
        if (here < left && here < right)
            break;
        index = node->children[left < right ? 0 : 1];
    }
    return index;
}

static void insert(Tree *tree, int leaf)
{
    if (tree->root == NOBODY) {
        tree->root = leaf;
        tree->nodes[leaf].parent = NOBODY;
        return;
    }
    int sibling = find_sibling(tree, tree->nodes[leaf].box), parent = take(tree);
    replace(tree, tree->nodes[sibling].parent, sibling, parent);
    tree->nodes[parent].children[0] = sibling;
    tree->nodes[parent].children[1] = leaf;
    tree->nodes[sibling].parent = tree->nodes[leaf].parent = parent;
    refit(tree, parent);
    mend_upwards(tree, parent);
}

static void detach(Tree *tree, int leaf)
{
    int parent = tree->nodes[leaf].parent;
    if (parent == NOBODY) {
        tree->root = NOBODY;
        return;
    }
    int above = tree->nodes[parent].parent;
    int sibling = tree->nodes[parent].children[tree->nodes[parent].children[0] == leaf];
    replace(tree, above, parent, sibling);
    give(tree, parent);
    mend_upwards(tree, above);
}

static Box widened(Box box)
{
    Vec margin = {MARGIN_AROUND, MARGIN_AROUND};
    return (Box){vec_sub(box.low, margin), vec_add(box.high, margin)};
}

int tree_add(Tree *tree, Box box, int owner)
{
    int leaf = take(tree);
    tree->nodes[leaf].box = widened(box);
    tree->nodes[leaf].owner = owner;
    insert(tree, leaf);
    return leaf;
}

void tree_remove(Tree *tree, int leaf)
{
    detach(tree, leaf);
    give(tree, leaf);
}

bool tree_move(Tree *tree, int leaf, Box box, Vec way)
{
    if (box_holds(tree->nodes[leaf].box, box))
        return false;
    detach(tree, leaf);
    Box wide = widened(box);
    Vec lead = vec_scale(LEAD, way);
    *(lead.x < 0 ? &wide.low.x : &wide.high.x) += lead.x;
    *(lead.y < 0 ? &wide.low.y : &wide.high.y) += lead.y;
    tree->nodes[leaf].box = wide;
    insert(tree, leaf);
    return true;
}

int tree_query(const Tree *tree, int leaf, int *found, int room)
{
    int stack[TREE_DEPTH], depth = 0, count = 0;
    Box box = tree->nodes[leaf].box;
    stack[depth++] = tree->root;
    while (depth && count < room) {
        int index = stack[--depth];
        const Node *node = &tree->nodes[index];
        if (!box_meets(node->box, box))
            continue;
        if (is_leaf(node))
            found[count++] = index;
        else if (depth + 2 <= TREE_DEPTH) {
            stack[depth++] = node->children[0];
            stack[depth++] = node->children[1];
        }
    }
    return count;
}
