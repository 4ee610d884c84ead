-- ================================================================================================
-- rosbayes: bm1_matrix
-- Lines and columns of one machine: prior elements, tile elements and counters (thesis, figure 2.4).
-- MIT licence; datasheet: docs/hardware/bm1_matrix.md
-- ================================================================================================

library ieee;
  use ieee.std_logic_1164.all;

library work;
  use work.bm1_parameters.all;
  use work.bm1_utilities.all;

entity bm1_matrix is
  generic (
    LINES         : positive;        -- number of lines on this board
    SENSORS       : natural;         -- number of sensor columns
    MODE          : sensor_mode_t;   -- kind of input that the cells of a sensor column get
    ADDRESS_BITS  : natural_array_t; -- address width of each sensor column, from 1 to SENSORS
    PROB_BITS     : positive;        -- width of a probability code
    PRIOR_BITS    : natural;         -- width of the prior's address
    WRITTEN       : boolean;         -- true: the host writes the prior; false: the prior is a table
    COUNTER_BITS  : positive;        -- width of a counter
    RNG_SHARED    : boolean;         -- true: one random number per column; false: one per cell
    MEMORY_PREFIX : string           -- start of the MIFs' paths: the folder and the board
  );
  port (
    clk_i : in    std_logic; -- clock
    -- control
    load_i       : in    std_logic;                                   -- latch the codes for the frame's inputs
    clear_i      : in    std_logic;                                   -- clear the counters
    enable_i     : in    std_logic;                                   -- run a cycle
    target_i     : in    std_logic_vector(COUNTER_BITS - 1 downto 0); -- target count
    overflow_o   : out   std_logic;                                   -- a counter is at the target
    impossible_o : out   std_logic;                                   -- every line has a cell with the code 0
    -- inputs of the frame
    prior_i       : in    std_logic_vector(SLOT_BITS - 1 downto 0);                                            -- address in the prior's table
    prior_codes_i : in    std_logic_vector(LINES * SLOT_BITS - 1 downto 0);                                    -- prior codes, line 0 lowest
    inputs_i      : in    std_logic_vector(SENSORS * inputs_per_column(MODE, LINES) * SLOT_BITS - 1 downto 0); -- inputs, column 1 lowest
    -- random numbers
    randoms_i : in    std_logic_vector(
      (SENSORS + 1) * (LINES + to_natural(RNG_SHARED) * (1 - LINES)) * PROB_BITS - 1 downto 0); -- random numbers, generator 0 in the low bits
    -- results
    counts_o : out   std_logic_vector(LINES * COUNTER_BITS - 1 downto 0) -- counters, line 0 in the low bits
  );
end entity bm1_matrix;

architecture rtl of bm1_matrix is

  constant COLUMNS    : positive := SENSORS + 1;
  constant PER_COLUMN : positive := inputs_per_column(MODE, LINES);

  signal prior_row   : std_logic_vector(LINES * PROB_BITS - 1 downto 0);
  signal column_rows : std_logic_vector(SENSORS * LINES * PROB_BITS - 1 downto 0);
  signal never       : std_logic_vector(LINES - 1 downto 0);
  signal full        : std_logic_vector(LINES - 1 downto 0);

begin

  prior_table : if not WRITTEN generate

    prior_probabilities : component bm1_table
      generic map (
        file_name    => MEMORY_PREFIX & "prior.mif",
        word_bits    => LINES * PROB_BITS,
        depth        => 2 ** PRIOR_BITS,
        address_bits => PRIOR_BITS + to_natural(PRIOR_BITS = 0),
        first_bit    => 0,
        data_bits    => LINES * PROB_BITS
      )
      port map (
        clk_i     => clk_i,
        enable_i  => load_i,
        address_i => prior_i(PRIOR_BITS + to_natural(PRIOR_BITS = 0) - 1 downto 0),
        data_o    => prior_row
      );

  end generate prior_table;

  column_tables : if MODE = SENSOR_COLUMN generate

    each_column : for c in 1 to SENSORS generate

      probabilities : component bm1_table
        generic map (
          file_name    => MEMORY_PREFIX & "column" & padded(c, SENSORS) & ".mif",
          word_bits    => LINES * PROB_BITS,
          depth        => 2 ** ADDRESS_BITS(c),
          address_bits => ADDRESS_BITS(c),
          first_bit    => 0,
          data_bits    => LINES * PROB_BITS
        )
        port map (
          clk_i     => clk_i,
          enable_i  => load_i,
          address_i => inputs_i((c - 1) * SLOT_BITS + ADDRESS_BITS(c) - 1 downto (c - 1) * SLOT_BITS),
          data_o    => column_rows(c * LINES * PROB_BITS - 1 downto (c - 1) * LINES * PROB_BITS)
        );

    end generate each_column;

  end generate column_tables;

  each_line : for l in 0 to LINES - 1 generate

    signal bits       : std_logic_vector(COLUMNS - 1 downto 0);
    signal nevers     : std_logic_vector(COLUMNS - 1 downto 0);
    signal prior_code : std_logic_vector(PROB_BITS - 1 downto 0);

    -- number of the generator of this line's first cell
    constant FIRST : natural := l * COLUMNS * to_natural(not RNG_SHARED);

  begin

    prior_source : if WRITTEN generate
      prior_code <= prior_codes_i(l * SLOT_BITS + PROB_BITS - 1 downto l * SLOT_BITS);
    else generate
      prior_code <= prior_row((l + 1) * PROB_BITS - 1 downto l * PROB_BITS);
    end generate prior_source;

    prior : entity work.bm1_prior_element
      generic map (
        prob_bits => PROB_BITS,
        written   => WRITTEN
      )
      port map (
        clk_i    => clk_i,
        load_i   => load_i,
        code_i   => prior_code,
        random_i => randoms_i((FIRST + 1) * PROB_BITS - 1 downto FIRST * PROB_BITS),
        bit_o    => bits(0),
        never_o  => nevers(0)
      );

    each_tile : for c in 1 to SENSORS generate

      signal given : std_logic_vector(SLOT_BITS - 1 downto 0);

      constant INPUT : natural := (c - 1) * PER_COLUMN + l * to_natural(MODE /= SENSOR_COLUMN);

    begin

      given_source : if MODE = SENSOR_COLUMN generate
        given(PROB_BITS - 1 downto 0) <= column_rows(((c - 1) * LINES + l + 1) * PROB_BITS - 1 downto ((c - 1) * LINES + l) * PROB_BITS);

        unused_bits : if PROB_BITS < SLOT_BITS generate
          given(SLOT_BITS - 1 downto PROB_BITS) <= (others => '0');
        end generate unused_bits;

      else generate
        given <= inputs_i((INPUT + 1) * SLOT_BITS - 1 downto INPUT * SLOT_BITS);
      end generate given_source;

      tile : entity work.bm1_tile_element
        generic map (
          prob_bits    => PROB_BITS,
          mode         => MODE,
          address_bits => ADDRESS_BITS(c),
          table_file   => MEMORY_PREFIX & "column" & padded(c, SENSORS) & ".mif",
          lines        => LINES,
          line         => l * to_natural(MODE = SENSOR_CELL)
        )
        port map (
          clk_i    => clk_i,
          load_i   => load_i,
          given_i  => given,
          random_i => randoms_i((FIRST + c + 1) * PROB_BITS - 1 downto (FIRST + c) * PROB_BITS),
          bit_i    => bits(c - 1),
          never_i  => nevers(c - 1),
          bit_o    => bits(c),
          never_o  => nevers(c)
        );

    end generate each_tile;

    counter : entity work.bm1_counter
      generic map (
        counter_bits => COUNTER_BITS
      )
      port map (
        clk_i    => clk_i,
        clear_i  => clear_i,
        enable_i => enable_i,
        bit_i    => bits(COLUMNS - 1),
        target_i => target_i,
        count_o  => counts_o((l + 1) * COUNTER_BITS - 1 downto l * COUNTER_BITS),
        full_o   => full(l)
      );

    never(l) <= nevers(COLUMNS - 1);
  end generate each_line;

  overflow_o   <= or full;
  impossible_o <= and never;

end architecture rtl;
