/* CarRacing's picture, drawn on one canvas a process, whatever the number of races: it is rebuilt for every picture. */

#include "scene.h"

#include "canvas.h"

static Canvas canvas;

/* ---- geometry, in double precision and in gymnasium's order of operations ---- */

typedef struct {
    double sine, cosine, zoom;
    Vector shift;
    int quarter; /* turns by a multiple of 90 degrees, which pygame makes exact; or -1 */
} View;

static const double EPSILON = 1e-6; /* pygame's Vector2 */
static const double QUARTER = 1.57079632679489661923;

static View view_of(double zoom, double angle)
{
    View view = {.zoom = zoom, .quarter = -1};
    angle = fmod(angle, 4 * QUARTER);
    if (angle < 0)
        angle += 4 * QUARTER;
    if (fmod(angle + EPSILON, QUARTER) < 2 * EPSILON)
        view.quarter = (int)((angle + EPSILON) / QUARTER) % 4;
    view.sine = turn_sine(angle);
    view.cosine = turn_cosine(angle);
    return view;
}

static Vector rotate(const View *view, Vector v)
{
    switch (view->quarter) {
    case 0:
        return v;
    case 1:
        return (Vector){-v.y, v.x};
    case 2:
        return (Vector){-v.x, -v.y};
    case 3:
        return (Vector){v.y, -v.x};
    default:
        return (Vector){view->cosine * v.x - view->sine * v.y, view->sine * v.x + view->cosine * v.y};
    }
}

static Vector project(const View *view, Vector v)
{
    Vector turned = rotate(view, v);
    return (Vector){turned.x * view->zoom + view->shift.x, turned.y * view->zoom + view->shift.y};
}

static int16_t short_of(double value)
{
    return (int16_t)(long)value;
}

/* A quadrilateral of the ground, if any of it can be seen: the first corner decides, for no side is longer. */
static void quadrilateral(const View *view, const Vector *corners, double reach, uint32_t colour)
{
    Vector first = project(view, corners[0]);
    if (first.x < -reach || first.x > WIDTH + reach || first.y < -reach || first.y > HEIGHT + reach)
        return;
    Point points[4];
    int left = 0, right = 0, low = 0, high = 0;
    for (int i = 0; i < 4; i++) {
        Vector p = i ? project(view, corners[i]) : first;
        points[i] = (Point){short_of(p.x), short_of(p.y)};
        left += points[i].x < 0;
        right += points[i].x > WIDTH - 1;
        low += points[i].y < HEIGHT - SCENE - 1;
        high += points[i].y > HEIGHT - 1;
    }
    if (left == 4 || right == 4 || low == 4 || high == 4)
        return;
    canvas_polygon(&canvas, points, 4, colour);
}

/* Whether a first corner may be near enough to be seen: cheaper than to project it. */
static inline bool is_within(Vector corner, Vector hull, double far)
{
    double x = corner.x - hull.x, y = corner.y - hull.y;
    return x * x + y * y <= far * far;
}

/* Whether the whole screen lies inside the field, with some pixels to spare. */
static bool field_covers(const View *view, double bounds)
{
    double spare = 8 / view->zoom;
    for (int corner = 0; corner < 4; corner++) {
        double x = ((corner & 1 ? WIDTH : 0) - view->shift.x) / view->zoom;
        double y = ((corner & 2 ? HEIGHT : 0) - view->shift.y) / view->zoom;
        double back_x = view->cosine * x + view->sine * y, back_y = view->cosine * y - view->sine * x;
        if (fabs(back_x) > bounds - spare || fabs(back_y) > bounds - spare)
            return false;
    }
    return true;
}

/* ---- the car: its pose in single precision, then the view ---- */

enum { RED = 0xcc0000, BLACK = 0, GREY = 0x4d4d4d };

static void car_polygon(const View *view, Pose at, const Vec *corners, int count, uint32_t colour)
{
    int x[CORNERS], y[CORNERS];
    for (int i = 0; i < count; i++) {
        Vec world = pose_out(at, corners[i]);
        Vector p = project(view, (Vector){world.x, world.y});
        x[i] = (int)p.x;
        y[i] = (int)p.y;
    }
    canvas_solid(&canvas, x, y, count, colour, false);
}

/* The light stripe that shows a wheel turning. */
static void stripe(const View *view, Pose at, double phase)
{
    double first = phase, second = phase + 1.2;
    double sine_1 = turn_sine(first), sine_2 = turn_sine(second);
    double cosine_1 = turn_cosine(first), cosine_2 = turn_cosine(second);
    if (sine_1 > 0 && sine_2 > 0)
        return;
    if (sine_1 > 0)
        cosine_1 = sign(cosine_1);
    if (sine_2 > 0)
        cosine_2 = sign(cosine_2);
    float width = (float)(14 * 0.02), near = (float)(27 * cosine_1 * 0.02), far = (float)(27 * cosine_2 * 0.02);
    car_polygon(view, at, (Vec[]){{-width, near}, {width, near}, {width, far}, {-width, far}}, 4, GREY);
}

static void draw_car(const View *view, const Race *race)
{
    for (int i = 0; i < BODIES; i++) {
        const Rigid *body = &race->island.bodies[i];
        for (int k = 0; k < body->fixtures; k++) {
            const Polygon *polygon = &body->fixture[k].polygon;
            car_polygon(view, body->pose, polygon->corners, polygon->count, i == HULL ? RED : BLACK);
        }
        if (i != HULL)
            stripe(view, body->pose, race->wheels[i].phase);
    }
}

/* ---- the scene ---- */

static const double FIELD = 2000 / 6.0, PATCH = 2000 / 6.0 / 20.0;

/* Nothing that drives gets near this; beyond it, pixels could not be counted in whole numbers. */
static bool near(double value)
{
    return fabs(value) <= 1e5;
}

static bool is_sound(const Race *race)
{
    for (int i = 0; i < BODIES; i++) {
        const Rigid *body = &race->island.bodies[i];
        if (!near(body->pose.at.x) || !near(body->pose.at.y) || !isfinite(body->angle))
            return false;
        if (i != HULL && !isfinite(race->wheels[i].phase))
            return false;
    }
    return near(race->time);
}

static uint32_t colour_of(const Race *race, const Quad *quad)
{
    if (quad->border)
        return quad->tile % 2 ? 0xff0000 : 0xffffff;
    return race->colours.road[race->tiles[quad->tile].plain ? 0 : quad->tile % SHADES];
}

static void draw_ground(const View *view, const Race *race, Vector hull)
{
    double reach = PATCH * sqrt(2) * view->zoom + 2;
    double far = hypot(WIDTH / 2.0 + reach, HEIGHT * 3 / 4.0 + reach) / view->zoom + 1; /* the hull is at (1/2, 1/4) */
    for (int x = -20; x < 20; x += 2)
        for (int y = -20; y < 20; y += 2) {
            double left = PATCH * x, low = PATCH * y, right = left + PATCH, high = low + PATCH;
            if (is_within((Vector){right, low}, hull, far))
                quadrilateral(view, (Vector[]){{right, low}, {left, low}, {left, high}, {right, high}}, reach,
                              race->colours.patch);
        }
    for (int i = 0; i < race->track.quad_count; i++) {
        const Quad *quad = &race->track.quads[i];
        if (is_within(quad->corners[0], hull, far))
            quadrilateral(view, quad->corners, reach, colour_of(race, quad));
    }
}

static bool draw_scene(const Race *race, uint8_t *out)
{
    const Rigid *body = &race->island.bodies[HULL];
    double t = race->time, zoom = 0.1 * 6.0 * fmax(1 - t, 0) + 2.7 * 6.0 * fmin(t, 1);
    if (!is_sound(race) || zoom <= 0)
        return false;
    Vector hull = {body->pose.at.x, body->pose.at.y};
    View view = view_of(zoom, -(double)body->angle);
    Vector scroll = rotate(&view, (Vector){-hull.x * zoom, -hull.y * zoom});
    view.shift = (Vector){WIDTH / 2.0 + scroll.x, HEIGHT / 4.0 + scroll.y};
    bool covered = field_covers(&view, FIELD);
    canvas_begin(&canvas, 0, SCENE - 1);
    if (!covered)
        quadrilateral(&view, (Vector[]){{FIELD, FIELD}, {FIELD, -FIELD}, {-FIELD, -FIELD}, {-FIELD, FIELD}}, INFINITY,
                      race->colours.ground);
    draw_ground(&view, race, hull);
    draw_car(&view, race);
    canvas_finish(&canvas, covered ? race->colours.ground : 0, 0, SCENE_ROWS, out);
    return !canvas.overflow;
}

/* ---- the bar of indicators ---- */

/* An indicator: a rectangle from (x, y) to (u, v), given as gymnasium gives its corners. */
static void indicator(double value, double x, double y, double u, double v, uint32_t colour)
{
    if (!(fabs(value) > 1e-4 && near(value)))
        return;
    int left = (int)x, top = (int)y, right = (int)u, bottom = (int)v;
    int upright_x[4] = {left, right, right, left}, upright_y[4] = {top, top, bottom, bottom};
    canvas_solid(&canvas, upright_x, upright_y, 4, colour, true);
}

static void upright(double place, double level, double value, uint32_t colour)
{
    double s = WIDTH / 40.0, h = HEIGHT / 40.0;
    indicator(value, place * s, HEIGHT - (h + h * level), (place + 1) * s, HEIGHT - h, colour);
}

static void level(double place, double length, double value, uint32_t colour)
{
    double s = WIDTH / 40.0, h = HEIGHT / 40.0;
    indicator(value, (place + 0) * s, HEIGHT - 4 * h, (place + length) * s, HEIGHT - 2 * h, colour);
}

static void draw_bar(const Race *race, uint8_t *out)
{
    const Rigid *hull = &race->island.bodies[HULL];
    double vx = hull->velocity.x, vy = hull->velocity.y, speed = sqrt(vx * vx + vy * vy);
    double steering = joint_angle(&race->island.joints[0], race->island.bodies);
    canvas_begin(&canvas, SCENE, HEIGHT - 1);
    upright(5, 0.02 * speed, speed, 0xffffff);
    for (int i = 0; i < WHEELS; i++)
        upright(7 + i, 0.01 * race->wheels[i].omega, race->wheels[i].omega, i < 2 ? 0x0000ff : 0x3300ff);
    level(20, -10.0 * steering, steering, 0x00ff00);
    level(30, -0.8 * hull->spin, hull->spin, 0xff0000);
    canvas_finish(&canvas, 0, SCENE_ROWS, CELLS, out);
}

/* ---- pictures ---- */

void scene_init(void)
{
    turn_init();
    canvas_init(&canvas);
}

int scene_widen(int most)
{
    return canvas_widen(most);
}

bool scene_draw(const Race *race, uint8_t *out)
{
    if (!draw_scene(race, out))
        return false;
    draw_bar(race, out + SCENE_ROWS * CELLS * 3);
    return true;
}

bool scene_draw_small(const Race *race, uint8_t *out)
{
    static uint8_t scene[SCENE_ROWS * CELLS * 3];
    bool drawn = draw_scene(race, scene);
    if (drawn)
        canvas_shrink(scene, out);
    return drawn;
}
