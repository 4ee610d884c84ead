-- ================================================================================================
-- rosbayes: bm1_tile_element
-- Cell of a sensor column: multiplies the bitstream of the line by P(K | S) (thesis, figure 2.2).
-- MIT licence; datasheet: docs/hardware/bm1_tile_element.md
-- ================================================================================================

library ieee;
  use ieee.std_logic_1164.all;

library work;
  use work.bm1_parameters.all;
  use work.bm1_utilities.all;

entity bm1_tile_element is
  generic (
    PROB_BITS    : positive;      -- width of a probability code
    MODE         : sensor_mode_t; -- kind of the cell's input
    ADDRESS_BITS : positive;      -- with SENSOR_CELL: address width of the table
    TABLE_FILE   : string;        -- with SENSOR_CELL: MIF of the column
    LINES        : positive;      -- with SENSOR_CELL: number of lines in a word of the MIF
    LINE         : natural        -- with SENSOR_CELL: number of the cell's line
  );
  port (
    clk_i    : in    std_logic;                                -- clock
    load_i   : in    std_logic;                                -- a frame starts: latch the cell's input
    given_i  : in    std_logic_vector(SLOT_BITS - 1 downto 0); -- code from the column's table, or the cell's input
    random_i : in    std_logic_vector(PROB_BITS - 1 downto 0); -- random number of the column or of this cell
    bit_i    : in    std_logic;                                -- bitstream of the cells to the left
    never_i  : in    std_logic;                                -- a cell to the left has the code 0
    bit_o    : out   std_logic;                                -- bitstream of the product
    never_o  : out   std_logic                                 -- this cell or a cell to the left has the code 0
  );
end entity bm1_tile_element;

architecture rtl of bm1_tile_element is

  signal code  : std_logic_vector(PROB_BITS - 1 downto 0);
  signal one   : std_logic;
  signal never : std_logic;

begin

  -- a chain of conditions: GHDL's synthesis does not know case generates

  source : if MODE = SENSOR_COLUMN generate
    -- The tables of a column have the same address: they share one memory in bm1_matrix.
    code <= given_i(PROB_BITS - 1 downto 0);
  elsif MODE = SENSOR_CELL generate

    probabilities : component bm1_table
      generic map (
        file_name    => TABLE_FILE,
        word_bits    => LINES * PROB_BITS,
        depth        => 2 ** ADDRESS_BITS,
        address_bits => ADDRESS_BITS,
        first_bit    => LINE * PROB_BITS,
        data_bits    => PROB_BITS
      )
      port map (
        clk_i     => clk_i,
        enable_i  => load_i,
        address_i => given_i(ADDRESS_BITS - 1 downto 0),
        data_o    => code
      );

  else generate

    hold_code : process (clk_i) is
    begin

      if rising_edge(clk_i) then
        if (load_i = '1') then
          code <= given_i(PROB_BITS - 1 downto 0);
        end if;
      end if;

    end process hold_code;

  end generate source;

  generator : entity work.bm1_stochastic_bitstream_generator
    generic map (
      prob_bits => PROB_BITS
    )
    port map (
      random_i => random_i,
      code_i   => code,
      bit_o    => one,
      never_o  => never
    );

  bit_o   <= bit_i and one;
  never_o <= never_i or never;

end architecture rtl;
